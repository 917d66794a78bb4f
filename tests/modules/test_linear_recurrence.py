import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from dreamer_racing.modules.linear_recurrence import linear_recurrence


class Counter(TorchDispatchMode):
    """Counts the calls of torch's operations."""

    calls = 0

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        self.calls += 1
        return function(*args, **kwargs or {})


def loop(decay: torch.Tensor, drive: torch.Tensor) -> torch.Tensor:
    found = [drive[:, 0]]
    for step in range(1, drive.shape[1]):
        found.append(decay[:, step] * found[-1] + drive[:, step])
    return torch.stack(found, 1)


def make_inputs(time: int) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    decay = torch.rand(2, time, 3, generator=generator)
    decay[1, time // 2] = 0.0
    return decay.requires_grad_(), torch.randn(2, time, 3, generator=generator).requires_grad_()


def test_a_constant_decay_makes_a_geometric_sum():
    found = linear_recurrence(torch.full((1, 40, 1), 0.75), torch.ones(1, 40, 1)).flatten()
    torch.testing.assert_close(found, (1 - 0.75 ** torch.arange(1, 41)) / 0.25)


@pytest.mark.parametrize("time", [1, 2, 3, 7, 8, 33])
def test_values_and_gradients_are_those_of_the_loop(time):
    inputs = make_inputs(time)
    weight = torch.randn(2, time, 3, generator=torch.Generator().manual_seed(1))
    found, expected = linear_recurrence(*inputs), loop(*inputs)
    torch.testing.assert_close(found, expected)
    ours = torch.autograd.grad((found * weight).sum(), inputs)
    theirs = torch.autograd.grad((expected * weight).sum(), inputs, allow_unused=True, materialize_grads=True)
    torch.testing.assert_close(ours, theirs)


def test_arguments_stay_as_they_were():
    decay, drive = (value.detach() for value in make_inputs(9))
    kept = decay.clone(), drive.clone()
    linear_recurrence(decay, drive)
    assert torch.equal(decay, kept[0]) and torch.equal(drive, kept[1])


@pytest.mark.parametrize("decay", [0.0, 1e-30, 1.0])
def test_extreme_decays_stay_finite_and_exact(decay):
    drive = torch.randn(2, 256, 3, generator=torch.Generator().manual_seed(0)).requires_grad_()
    found = linear_recurrence(torch.full((2, 256, 3), decay), drive)
    torch.testing.assert_close(found, drive.cumsum(1) if decay == 1.0 else drive, rtol=1e-5, atol=1e-5)
    found.sum().backward()
    assert drive.grad.isfinite().all()


def test_calls_grow_with_the_logarithm_of_the_length():
    calls = {}
    for time in (16, 32, 256):
        inputs = make_inputs(time)
        with Counter() as counter:
            linear_recurrence(*inputs).sum().backward()
        calls[time] = counter.calls
    a_round = calls[32] - calls[16]
    assert a_round > 0 and calls[256] == calls[16] + 4 * a_round
