"""Processes that train together: the exchanges, and updates of the shares of a batch against those of the whole."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from dreamer_racing import parallel
from dreamer_racing.experience.replay import StreamReplay, make_replay
from dreamer_racing.learners.config import LearnerConfig
from dreamer_racing.learners.dreamer_v3 import DreamerV3
from dreamer_racing.learners.gradient_step import NonFiniteLossError
from dreamer_racing.learners.latent_ppo import LatentPPO
from dreamer_racing.learners.update import WorldModelLearner
from dreamer_racing.losses import DreamerV3Losses, LatentPPOLosses, PPOUpdateConfig
from dreamer_racing.modules import Agent, Interface, get_size
from dreamer_racing.modules.heads import ActionDistribution
from dreamer_racing.modules.rssm import LatentFormat
from dreamer_racing.training.checkpoint import RunCheckpointError, RunCheckpoints, newest_sound
from dreamer_racing.training.session import Session
from dreamer_racing.training.signals import GracefulExit
from tests.forked import Forked
from tests.learners.test_dreamer_v3 import make_batch

SIZE = replace(get_size("debug"), sampled=False)  # nothing is drawn: an update is a function of its batch
SEES = Interface(privileged_dim=5)
WINDOWS, LENGTH = 4, 6  # of the joint batch
WORLDS, STEPS = 4, 8  # of the joint rollout
PPO = PPOUpdateConfig(steps=WORLDS * STEPS, epochs=3, minibatch=2 * WORLDS, kl_stop=1e9)
OF_STATE = LatentPPOLosses(critic="state", world_model="privileged", ppo=PPO, drift_scale=1.0)
Losses = DreamerV3Losses | LatentPPOLosses


def share_of_ppo(ppo: PPOUpdateConfig) -> PPOUpdateConfig:
    """The numbers of each process."""
    return replace(
        ppo, steps=ppo.steps // parallel.num_processes(), minibatch=ppo.minibatch // parallel.num_processes()
    )


def share(whole: TensorDict | Tensor) -> TensorDict | Tensor:
    """What this process has of a joint batch or rollout."""
    return whole.chunk(parallel.num_processes())[parallel.rank()]


def make_learner(losses: Losses = OF_STATE) -> WorldModelLearner:
    """With an optimiser that is linear in gradients, so that differences of weights are those of gradients."""
    torch.manual_seed(0)
    agent = Agent(SIZE, SEES, decode=losses.world_model == "reconstruction")
    output = agent.critic.head.mlp.output
    torch.nn.init.normal_(output.weight, std=0.3)
    bins = len(output.bias)
    output.bias.data -= (torch.arange(bins) - bins // 2).abs()  # values near 0, or rounding shows in symexp's far bins
    config = LearnerConfig(imagination_horizon=3)
    learner: WorldModelLearner
    if isinstance(losses, LatentPPOLosses):
        learner = LatentPPO(agent, replace(losses, ppo=share_of_ppo(losses.ppo)), config)
    else:
        learner = DreamerV3(agent, losses, config)
    groups = [{"params": group["params"]} for group in learner.optimizer.param_groups]
    learner.optimizer = torch.optim.SGD(groups, lr=0.005)
    return learner


def joint_batch(seed: int) -> TensorDict:
    generator = torch.Generator().manual_seed(seed)
    batch = make_batch(WINDOWS, LENGTH)
    batch["reward"] += torch.randn(batch["reward"].shape, generator=generator)
    widths = [SIZE.belief, SIZE.state]
    latents = torch.rand(WINDOWS, LENGTH, sum(widths), generator=generator).split(widths, -1)
    batch["context"] = LatentFormat(SIZE.belief, SIZE.latents, SIZE.classes, sampled=False).pack(*latents)
    return batch.set(("privileged", "vector"), torch.randn(WINDOWS, LENGTH, 5, generator=generator))


def joint_rollout(learner: WorldModelLearner) -> TensorDict:
    """As the policy flew it; it is the same in all processes."""
    generator = torch.Generator().manual_seed(7)
    shape = (WORLDS, STEPS)
    belief = torch.rand(*shape, SIZE.belief, generator=generator) * 2 - 1
    state = torch.rand(*shape, SIZE.state, generator=generator)
    with torch.no_grad():
        policy = learner.agent.actor(torch.cat((belief, state), -1))
    action = (policy.mean + policy.std * torch.randn(policy.mean.shape, generator=generator)).clamp(-1.0, 1.0)
    done = torch.rand(*shape, 1, generator=generator) < 0.1
    came = {"reward": torch.randn(*shape, 1, generator=generator), "done": done, "terminated": done}
    seen = {"action": action, "previous_action": 0 * action, "loc": policy.mean, "scale": policy.std}
    privileged = {"vector": torch.randn(*shape, 5, generator=generator)}
    after = {"belief": belief, "state": state, **came}
    return TensorDict({**seen, "privileged": privileged, "next": after}, shape)


def weights(learner: WorldModelLearner) -> dict[str, Tensor]:
    """Everything that an update changes, but for what was collected."""
    networks = {"agent": learner.agent, **learner.own_networks}
    found = {f"{name}.{key}": value for name, part in networks.items() for key, value in part.state_dict().items()}
    if isinstance(learner, LatentPPO):
        found["learning_rate_scale"] = learner.actor_update.learning_rate_scale
    else:
        assert isinstance(learner, DreamerV3)
        found |= {f"return_range.{key}": value for key, value in learner.return_range.state_dict().items()}
    return {name: value.clone() for name, value in found.items()}


def in_order(number: int, device: torch.device | None = None) -> Tensor:
    """In place of `torch.randperm`: minibatches of the shares then make up those of the whole."""
    return torch.arange(number, device=device)


def train_a_little(config: Losses, updates: int = 3) -> dict[str, Tensor]:
    """Updates, one of the actor among them; the weights and the metrics after them."""
    torch.randperm, ActionDistribution.sample = in_order, lambda policy: policy.mean  # of a process of its own
    learner = make_learner(config)
    if isinstance(learner, LatentPPO):
        learner.collect(share(joint_rollout(learner)))
    metrics: dict[str, Tensor] = {}
    for seed in range(updates):
        metrics |= learner.update(share(joint_batch(seed)))
    names = [name for name in metrics if name != "ppo/explained_variance"]  # no mean over records
    return weights(learner) | {name: metrics[name] for name in names}


# What follows runs in processes of their own, started by `together`.


def updates_of_shares(folder: Path) -> None:
    for name, config in CONFIGS.items():
        torch.save(train_a_little(config), folder / f"{name}_{parallel.num_processes()}_{parallel.rank()}.pt")


def exchanges(folder: Path) -> None:
    rank = parallel.rank()
    still, moved = torch.zeros(2, requires_grad=True), torch.zeros(2, 2, requires_grad=True)
    moved.grad = torch.full((2, 2), float(rank))
    means = parallel.average_gradients([still, moved], {"loss": torch.tensor(1.0 + rank)})
    assert moved.grad.tolist() == [[0.5, 0.5], [0.5, 0.5]] and still.grad is None and means == {"loss": 1.5}
    assert parallel.total(torch.tensor([1.0, rank])).tolist() == [2.0, 1.0]
    assert parallel.all_gather(torch.full((1, 2), rank), dim=1).tolist() == [[0, 0, 1, 1]]
    rows = TensorDict({"return": torch.arange(rank + 1)}, [rank + 1])
    assert parallel.all_gather_rows(rows)["return"].tolist() == [0, 0, 1]
    assert parallel.all_gather_rows(rows[: 1 - rank])["return"].tolist() == [0], "one process may have none"
    assert parallel.broadcast({"path": rank}) == {"path": 0}
    assert parallel.all_reduce_max(rank) == 1
    parallel.check_same([torch.ones(3)])
    with pytest.raises(RuntimeError, match="networks differ between"):
        parallel.check_same([torch.ones(3) + 1e-7 * rank])
    with pytest.raises((RuntimeError, OSError), match="full"):
        parallel.run_in_all(lambda: fail("disk full") if rank else None)


def fail(words: str) -> None:
    raise OSError(words)


def bad_number(folder: Path) -> None:
    """A reward that is no number in one process ends all of them, at the same update."""
    learner = make_learner()
    batch = share(joint_batch(0))
    if parallel.rank():
        batch["reward"][0, 1] = torch.nan
    before = weights(learner)
    with pytest.raises(NonFiniteLossError):
        learner.update(batch)
    assert all(torch.equal(value, before[name]) for name, value in weights(learner).items())


def stop_at_once(folder: Path) -> None:
    """A divergence that is large in one process alone ends the epochs of all, and slows all down."""
    config = replace(OF_STATE, ppo=replace(PPO, epochs=50, learning_rate=0.01, kl_target=0.01, kl_stop=0.02))
    learner = make_learner(config)
    rollout = joint_rollout(learner)
    rollout["next", "reward"][: WORLDS // 2] *= 100.0
    learner.collect(share(rollout))
    metrics = learner.update(share(joint_batch(0)))
    assert 0 < metrics["ppo/epochs"] < 50 and metrics["ppo/learning_rate_scale"] == 1.0
    assert isinstance(learner, LatentPPO) and learner.actor_update.learning_rate_scale < 1.0
    parallel.check_same([*weights(learner).values(), metrics["ppo/epochs"], metrics["ppo/kl"]])


def signal_at_one(folder: Path) -> None:
    with GracefulExit() as stop:
        session: Any = SimpleNamespace(_stop=stop, _signal=0)
        is_stopping = partial(Session.stopping.fget, session)
        assert not is_stopping()
        if parallel.rank():
            os.kill(os.getpid(), 15)
        assert not session._signal, "not before all know"
        assert is_stopping() and is_stopping() and session._signal == 15


def make_share_of_replay(total_worlds: int = 8, held_out: int = 1) -> StreamReplay:
    worlds = total_worlds // parallel.num_processes()
    held_out = held_out if parallel.is_first() else 0
    seed = parallel.rank()
    return make_replay(20 * worlds, worlds, 2, 4, seed=seed, observation_keys=["pixels"], held_out=held_out)


def flown_rollout(worlds: int, steps: int, value: int) -> TensorDict:
    flag = torch.zeros(worlds, steps, 1, dtype=torch.bool)
    pixels = torch.full((worlds, steps, 2, 2, 3), value, dtype=torch.uint8)
    pixels += torch.arange(worlds, dtype=torch.uint8).view(-1, 1, 1, 1, 1)
    number = torch.zeros(worlds, steps, 1)
    after = {"reward": number, "reward_base": number, "body_rate_norm": number, "terminated": flag, "truncated": flag}
    root = {"pixels": pixels, "action": torch.zeros(worlds, steps, 4), "is_init": flag}
    return TensorDict({**root, "next": {"pixels": pixels, **after}}, [worlds, steps])


def contents(replay: StreamReplay) -> list[list[int]]:
    return [replay.records(stream)["pixels"][:, 0, 0, 0].tolist() for stream in range(replay.num_streams)]


def save_shares(folder: Path) -> None:
    """Streams of different lengths, one of them a ring that went round; the counters are common."""
    replay = make_share_of_replay()
    replay.extend(flown_rollout(replay.num_streams, 15, 10 * (parallel.rank() + 1)))
    if parallel.rank():
        replay.extend(flown_rollout(replay.num_streams, 15, 100))
    counters = {"env_steps": 120}
    checkpoints = RunCheckpoints(folder, {"counters": counters, "replay": replay}, own=["replay"])
    checkpoints.save(120)
    torch.save(contents(replay), folder / f"contents_{parallel.rank()}.pt")
    torch.save(torch.rand(3), folder / f"random_{parallel.rank()}.pt")
    checkpoints.load()
    assert torch.equal(torch.rand(3), torch.load(folder / f"random_{parallel.rank()}.pt"))
    assert contents(replay) == torch.load(folder / f"contents_{parallel.rank()}.pt")
    parts = {"counters": counters, "replay": Unsavable() if parallel.rank() else replay}
    checkpoints = RunCheckpoints(folder, parts, own=["replay"])
    with pytest.raises(RunCheckpointError, match="full"):
        checkpoints.save(130)
    parallel.run_in_all(lambda: None)  # the first has cleared it away
    assert [path.name for path in (folder / "checkpoints").iterdir()] == ["checkpoint-000000000120"]


class Unsavable:
    """A replay on a full disk."""

    def dump(self, path: Path) -> None:
        raise OSError("disk full")

    def load(self, path: Path) -> None:
        raise NotImplementedError


def load_shares(folder: Path) -> None:
    """Eight worlds that two processes left, the first one's last: held out before, and held out now."""
    left = [torch.load(folder / f"contents_{rank}.pt") for rank in (1, 0)]
    replay, counters = make_share_of_replay(), {"env_steps": 0}
    RunCheckpoints(folder, {"counters": counters, "replay": replay}, own=["replay"]).load()
    joint, number = left[0] + left[1], replay.num_streams
    skip = (parallel.num_processes() - 1 - parallel.rank()) * number
    assert contents(replay) == joint[skip : skip + number] and counters == {"env_steps": 120}
    assert len(replay) == sum(map(len, joint[skip : skip + number]))
    replay.extend(flown_rollout(number, 3, 200))
    assert contents(replay)[0][-3:] == [200, 200, 200] and replay.sample()["index"].shape == (2, 4)


CONFIGS = {
    "state": OF_STATE,
    "latent": replace(OF_STATE, critic="latent"),
    # A scale that is of the last returns alone, and an entropy that moves the actor.
    "reinforce": DreamerV3Losses(actor="reinforce", world_model="privileged", return_decay=0.0, entropy_scale=0.3),
}


def together(tmp_path: Path, processes: int, *works: Callable[[Path], None]) -> None:
    """Do some things in several processes that meet as those of torchrun do; each may fail."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    shared = {"WORLD_SIZE": processes, "LOCAL_WORLD_SIZE": processes, "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port}
    members = [
        Forked(
            _meet,
            tmp_path,
            [work.__name__ for work in works],
            cwd=tmp_path,
            environment={name: str(value) for name, value in {**shared, "RANK": rank, "LOCAL_RANK": rank}.items()},
        )
        for rank in range(processes)
    ]
    for done in [member.communicate(timeout=240) for member in members]:
        assert done.returncode == 0, done.stderr


def _meet(tmp_path: Path, works: list[str]) -> None:
    torch.set_num_threads(1)
    parallel.init()
    try:
        for work in works:
            globals()[work](tmp_path)
    finally:
        parallel.destroy()


def test_a_single_process_exchanges_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("WORLD_SIZE", raising=False)
    parallel.init()
    assert not torch.distributed.is_initialized()
    value = torch.ones(2)
    assert (
        parallel.total(value) is value and parallel.all_gather(value, 0) is value and parallel.broadcast(value) is value
    )
    assert (parallel.num_processes(), parallel.rank(), parallel.is_first()) == (1, 0, True)


def test_processes_that_cannot_meet_are_told_how(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WORLD_SIZE", "2")
    for name in ("RANK", "MASTER_ADDR", "MASTER_PORT"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(ValueError, match=r"WORLD_SIZE=2.*torchrun --nproc-per-node=N"):
        parallel.init()


@pytest.mark.slow
def test_two_processes_agree(tmp_path: Path) -> None:
    together(tmp_path, 2, exchanges, bad_number, stop_at_once, signal_at_one)


@pytest.mark.slow
def test_updates_of_two_shares_are_those_of_the_whole(tmp_path: Path) -> None:
    """Weights after three updates, one of the actor among them: of one process, of two, and of those two each."""
    together(tmp_path, 1, updates_of_shares)
    together(tmp_path, 2, updates_of_shares)
    for name, config in CONFIGS.items():
        whole, first, second = (torch.load(tmp_path / f"{name}_{place}.pt") for place in ("1_0", "2_0", "2_1"))
        begun = weights(make_learner(config))
        for key, value in whole.items():
            near = {"rtol": 1e-5, "atol": 1e-5} if key in begun else {"rtol": 1e-3, "atol": 1e-4}  # else a metric
            assert torch.allclose(first[key], value, **near), f"{name}: {key} {first[key]} is not {value}"
            assert torch.equal(first[key], second[key]), f"{name}: {key} differs between the processes"
        own = {"state": ["state_critic"], "latent": ["latent_critic"]}.get(name, [])
        for part in ("agent.world_model.rssm", "agent.critic", "agent.actor", *own):
            moved = (whole[key] - value for key, value in begun.items() if key.startswith(part))
            assert max(float(distance.abs().max()) for distance in moved) > 1e-4, f"{name}: {part} stands still"


@pytest.mark.slow
def test_a_checkpoint_of_two_processes_is_restored_by_one_two_or_four(tmp_path: Path) -> None:
    together(tmp_path, 2, save_shares, load_shares)
    for processes in (1, 4):
        together(tmp_path, processes, load_shares)
    (saved,) = (tmp_path / "checkpoints").iterdir()
    for file in [path for path in sorted((saved / "process-1").rglob("*")) if path.is_file()]:
        content = file.read_bytes()
        file.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
        with pytest.raises(RunCheckpointError, match="process-1/.* does not match its checksum"):
            newest_sound(saved)
        file.write_bytes(content)
    assert newest_sound(saved, ["counters"]) == saved
    (saved / "process-1" / "manifest.json").unlink()
    with pytest.raises(RunCheckpointError, match=r"process-1/manifest\.json does not match its checksum"):
        newest_sound(saved, ["counters"])
