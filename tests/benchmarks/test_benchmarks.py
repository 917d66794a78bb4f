"""What benchmarks measure."""

from __future__ import annotations

import json
import math
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from tensordict import TensorDict

from dreamer_racing import machine
from dreamer_racing.modules.heads import ActionDistribution, symexp
from tests.running_recipes import module_of


def test_records_name_the_commit_that_measuring_began_at(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    measuring = module_of("benchmarks", "measuring")
    begun = machine.provenance()["commit"]
    monkeypatch.setattr(machine, "git_commit", lambda folder: "later")
    assert machine.provenance()["commit"] == "later" != begun
    measuring.write_json([{"speed": 1.0}, {"speed": 2.0}], str(tmp_path / "sub" / "records.json"))
    records = json.loads((tmp_path / "sub" / "records.json").read_text())
    assert [(record["speed"], record["commit"]) for record in records] == [(1.0, begun), (2.0, begun)]


# What a linear map and a probe do not tell of latents: nothing, all, or only what is tangled.


state_estimation = module_of("benchmarks", "state_estimation")


def shown(number: int, tangled: bool) -> tuple[torch.Tensor, torch.Tensor]:
    """Latents, probabilities among them, and a state that is linear in them or in products of them."""
    latents = torch.randn(number, 4)
    state = latents[:, :2] * latents[:, 2:] if tangled else latents[:, :2] + 2.0 * latents[:, 2:]
    return torch.cat((latents, torch.softmax(torch.randn(number, 3), -1)), 1), symexp(state)


@pytest.mark.parametrize(("tangled", "least", "most"), [(False, 0.0, 1e-6), (True, 0.95, 1.1)])
def test_a_linear_map_tells_what_is_linear(tangled: bool, least: float, most: float) -> None:
    torch.manual_seed(0)
    assert least <= state_estimation.linear_share(shown(4000, tangled), shown(1000, tangled)) <= most


def test_a_probe_that_learns_on_tells_what_is_tangled() -> None:
    torch.manual_seed(0)
    learned, measured = shown(4000, tangled=True), shown(1000, tangled=True)
    probe = state_estimation.Probe(7, 2)
    late = state_estimation.settle(probe, learned, measured, 20)["share"]
    assert state_estimation.settle(probe, learned, measured, 400)["share"] < 0.5 * late


# `benchmarks/learning_signal.py`: what it makes of rollouts and gradients that can be worked out by hand.


learning_signal = module_of("benchmarks", "learning_signal")


def column(*numbers: float) -> torch.Tensor:
    """Numbers of one start or world by step, ``(H, 1, 1)``."""
    return torch.tensor(numbers).view(-1, 1, 1)


def test_returns_and_what_is_reached_end_with_a_crash() -> None:
    rollout = learning_signal.Rollout(column(1.0, 2.0, 4.0), column(1.0, 0.0, 1.0), column(9.0, 10.0, 20.0, 30.0))
    learner = SimpleNamespace(discount=0.5, loss_config=SimpleNamespace(lambda_=1.0))
    assert rollout.returns(learner).flatten().tolist() == [1.0 + 0.5 * 2.0, 2.0, 4.0 + 0.5 * 30.0]
    assert rollout.reached().flatten().tolist() == [1.0, 1.0, 0.0, 0.0]
    learner.loss_config.lambda_ = 0.0
    assert rollout.returns(learner).flatten().tolist() == [1.0 + 0.5 * 10.0, 2.0, 4.0 + 0.5 * 30.0]


def test_what_was_paid_is_summed_to_the_end_of_an_episode() -> None:
    done = torch.tensor([False, True, False]).view(3, 1, 1)
    flight = TensorDict({"reward": column(1.0, 2.0, 4.0), "done": done}, [3, 1])
    assert learning_signal.monte_carlo(flight, 0.5).flatten().tolist() == [2.0, 2.0, 4.0]


@pytest.mark.parametrize(("share", "signal"), [(0.0, 0.0), (1.0, 1.0), (3.0, 9.0)])
def test_signal_and_noise_are_told_apart(share: float, signal: float) -> None:
    """Signal of a known power, noise of power 1, by many gradients."""
    noise = torch.randn(400, 1000) / 1000**0.5
    found = learning_signal.noise_of(noise + share * torch.nn.functional.normalize(torch.ones(1000), dim=0))
    assert found["signal"] == pytest.approx(signal, abs=0.02 + 0.02 * signal)
    assert found["cosine"] == pytest.approx(signal / (1 + signal), abs=0.02)


class LineActor(torch.nn.Module):
    """A policy with one mean everywhere."""

    def __init__(self) -> None:
        super().__init__()
        self.mean = torch.nn.Parameter(torch.zeros(1))

    def forward(self, features: torch.Tensor) -> ActionDistribution:
        return ActionDistribution(self.mean.expand(*features.shape[:-1], 1), torch.full_like(features, 0.3))


class LineModel(torch.nn.Module):
    """What is done is where one is and what is paid, and nothing ends."""

    few_kernels = False

    def imagine_step(self, belief: torch.Tensor, state: torch.Tensor, action: torch.Tensor) -> tuple[torch.Tensor, ...]:
        return action, state


@pytest.mark.parametrize("objective", learning_signal.OF_IMAGINED_STEPS)
def test_gradients_of_both_objectives_are_that_of_what_is_paid(objective: str) -> None:
    actor, model, critic = LineActor(), LineModel(), torch.nn.Module()
    model.rssm, critic.value = model, torch.zeros_like
    model.reward_head = SimpleNamespace(mean=lambda features: features)
    model.continue_head = SimpleNamespace(probability=torch.ones_like)
    learner = SimpleNamespace(
        horizon=1,
        discount=0.9,
        loss_config=SimpleNamespace(lambda_=0.95),
        agent=SimpleNamespace(actor=actor, critic=critic, world_model=model),
    )
    still = torch.zeros(4000, 1)
    starts = TensorDict({"belief": still, "state": still[:, :0], "terminated": still}, [4000])
    assert learning_signal.gradient(learner, starts, objective).item() == pytest.approx(-1.0, abs=0.1)


def test_a_common_cosine_is_that_of_the_means_without_their_noise() -> None:
    torch.manual_seed(0)
    one, other = torch.nn.functional.normalize(torch.randn(2, 1000), dim=1)
    noisy = [8 * torch.randn(64, 1000) / 1000**0.5 for _ in range(2)]
    assert learning_signal.common_cosine(noisy[0] + 4 * one, noisy[1] - 4 * one) == pytest.approx(-1.0, abs=0.1)
    assert learning_signal.common_cosine(noisy[0] + 4 * one, noisy[1] + 4 * other) == pytest.approx(0.0, abs=0.1)
    cancelling = torch.stack((one, -one))
    assert math.isnan(learning_signal.common_cosine(cancelling, cancelling))  # mostly noise, both of them


def test_the_gradient_of_collected_steps_is_that_of_what_is_paid() -> None:
    """Each action is paid at once, so the mean reward rises by 1 with the mean action."""
    torch.manual_seed(0)
    actor = LineActor()
    agent = SimpleNamespace(actor=actor, critic=SimpleNamespace(value=torch.zeros_like))
    learner = SimpleNamespace(agent=agent, discount=torch.tensor(0.9), loss_config=SimpleNamespace(lambda_=0.0))
    action = (0.3 * torch.randn(40, 500, 1)).clamp(-1.0, 1.0)
    at = torch.zeros(40, 500, 1)
    flight = TensorDict(
        {"belief": at, "state": at[..., :0], "action": action, "reward": action, "done": at > 0}, [40, 500]
    )
    assert learning_signal.collected_gradient(learner, flight).item() == pytest.approx(-1.0, abs=0.05)
