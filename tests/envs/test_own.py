"""Rewards and observations of one's own: the page's, in every environment, and what is refused."""

from __future__ import annotations

import importlib
import math
import re
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from torch import Tensor
from torchrl.envs.utils import check_env_specs

from dreamer_racing.envs import Camera, DroneRacingEnv, RaceWorlds, load
from dreamer_racing.envs.own import CustomFunction, RaceState, Transition
from dreamer_racing.modules import Interface

PAGE = (Path(__file__).parents[2] / "docs" / "own_rewards.md").read_text(encoding="utf-8")
*WRITTEN, USED = re.findall(r"^```python\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
OWN: dict[str, Any] = {}
exec("\n".join(WRITTEN), OWN)
SMALL: dict[str, Any] = {"num_envs": 3, "from_pixels": False, "seed": 0}
ACTIONS = torch.rand(6, 3, 4, generator=torch.Generator().manual_seed(1)) * 2.4 - 1.2


def fly(**own: Any) -> tuple[RaceWorlds, list[Tensor]]:
    """Worlds that have flown, and the rewards of their steps."""
    worlds = RaceWorlds("circle", **SMALL, **own)
    worlds.reset()
    return worlds, [worlds.step(action).reward_base for action in ACTIONS]


def test_the_page_runs_in_ones_own_code(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    file = ModuleType("my_rewards")
    vars(file).update(OWN)
    monkeypatch.setitem(sys.modules, "my_rewards", file)
    exec(USED, {})
    assert "[4, 20, 1]" in (printed := capsys.readouterr().out) and "[4, 20, 5]" in printed


def test_a_function_that_returns_the_default_changes_nothing() -> None:
    plain, paid = fly()
    own, paid_by_own = fly(reward=lambda step: step.default_reward, vector=lambda state: state.race_vector)
    assert all(map(torch.equal, paid, paid_by_own))
    assert torch.equal(plain.vector(), own.observed_vector())
    assert "last_action" not in plain.state_dict()


def test_changes_of_the_action_cost_what_the_page_says() -> None:
    _, default = fly()
    worlds, smooth = fly(reward=OWN["smooth"])
    flown = ACTIONS.clamp(-1.0, 1.0)
    torch.testing.assert_close(smooth[0], default[0])
    for step in range(1, len(flown)):
        change = (flown[step] - flown[step - 1]).square().sum(-1)
        torch.testing.assert_close(smooth[step], default[step] - 0.05 * change)
    worlds.reset(torch.tensor([True, False, False]))
    assert worlds.race_state().action[0].eq(0).all() and worlds.race_state().action[1:].ne(0).all()


def test_progress_is_that_towards_the_gate_of_the_step() -> None:
    _, default = fly()
    _, progress = fly(reward=OWN["progress"])
    for expected, paid in zip(default, progress, strict=True):  # nobody passes or crashes so soon
        torch.testing.assert_close(paid, expected)


def test_a_step_says_where_it_led_and_what_came_of_it() -> None:
    kept: list[Transition] = []

    def keep(step: Transition) -> Tensor:
        kept.append(step)
        return step.default_reward.unsqueeze(-1)

    worlds, _ = fly(reward=keep)
    first, second = kept[:2]
    for name in {*vars(first.after), "race_vector"} - {"make_race_vector"}:
        value = getattr(first.after, name)
        assert torch.equal(value, getattr(second.before, name)), name
        assert value.dtype == torch.float32, name
    assert torch.equal(first.before.time, torch.zeros(3)) and second.before.time[0] == pytest.approx(0.02)
    last = kept[-1].after
    assert torch.equal(last.gate_position, worlds.track.gate_positions()[worlds.race.target_gate])
    assert torch.equal(last.gate_direction, worlds.track.gate_normals()[worlds.race.target_gate])
    assert torch.equal(last.position, worlds.privileged()["position"])


def test_non_finite_states_are_given_as_zeros() -> None:
    worlds, _ = fly(reward=lambda step: step.after.position.sum(-1))
    worlds.simulator.state.position[1] = torch.nan
    assert worlds.race_state().position[1].eq(0).all()
    assert worlds.step(torch.full((3, 4), torch.nan)).terminated.all()


@pytest.mark.parametrize("from_pixels", [False, True])
def test_the_agent_sees_ones_own_numbers(from_pixels: bool) -> None:
    small = SMALL | {"from_pixels": from_pixels, "camera": Camera(32, 32)}
    env = DroneRacingEnv("circle", **small, vector=OWN["gate_and_action"])
    interface = Interface.of(env)
    assert (interface.pixels, interface.vector_dim, interface.privileged_dim) == (from_pixels, 5, 21)
    assert interface.observation_keys == ["pixels"] * from_pixels + ["vector"]
    if not from_pixels:
        check_env_specs(env)
    flown = env.rollout(4, break_when_any_done=False)
    torch.testing.assert_close(flown["next", "vector"][..., 1:], flown["action"])
    to_gate = env.track.gate_positions()[flown["privileged", "target_gate"].squeeze(-1)]
    torch.testing.assert_close(
        flown["vector"][..., 0], (to_gate - flown["privileged", "position"]).norm(dim=-1), atol=1e-5, rtol=1e-5
    )
    env.close()


def test_gymnasium_and_dm_control_take_them() -> None:
    own = {"reward": lambda step: torch.full((1,), 7.0), "vector": OWN["gate_and_action"]}
    single = gymnasium.make("dreamer_racing:dreamer_racing/Circle-v0", observation="vector", **own)
    observation, _ = single.reset(seed=0)
    assert single.observation_space.shape == observation.shape == (5,)
    action = np.full(4, 0.5, np.float32)
    observation, reward, *_ = single.step(action)
    assert reward == 7.0 and observation[1:].tolist() == action.tolist()
    race = load("circle", random=0, **own)
    assert race.reset().observation["vector"][1:].tolist() == [0.0] * 4
    step = race.step(action)
    assert step.reward == 7.0 and step.observation["vector"].shape == race.observation_spec()["vector"].shape == (5,)
    assert step.observation["vector"][1:].tolist() == action.tolist()
    with pytest.raises(ValueError, match="vector= is for observation='vector' or 'pixels_vector', not 'state'"):
        gymnasium.make("dreamer_racing/Circle-v0", observation="state", vector=own["vector"])


class Constant:
    """A class whose objects are called."""

    def __call__(self, step: Transition) -> Tensor:
        return torch.full_like(step.default_reward, 2.0)


def test_a_class_is_called_by_an_object_of_it() -> None:
    assert all(paid.eq(2.0).all() for paid in fly(reward=Constant)[1])


def uneven() -> Any:
    sizes = iter((2, 2, 3))
    return lambda state: torch.zeros(3, next(sizes))


@pytest.mark.parametrize(
    ("own", "message"),
    [
        ({"reward": lambda step: torch.zeros(3, 3)}, r"reward=<lambda> returned a tensor of shape \(3, 3\): must be"),
        ({"reward": lambda step: torch.zeros(())}, r"shape \(\): must be \(3,\) or \(3, 1\), a reward for each drone"),
        ({"reward": lambda step: 1.0}, "returned float: must be a tensor on cpu"),
        ({"reward": lambda step: step.default_reward / 0}, "reward=<lambda> returned numbers that are not finite"),
        ({"reward": "smooth"}, "reward='smooth': must be a function, or its name as module:function"),
        ({"reward": "no_such:smooth"}, r"reward=no_such:smooth was not found: there is no no_such\.py in"),
        ({"reward": "math:sqroot"}, r"module 'math' has no 'sqroot' \(did you mean sqrt\?\)"),
        ({"vector": 3}, "vector=3: must be a function"),
        ({"vector": lambda state: state.time}, r"shape \(3,\): must be \(3, V\), V numbers for each drone"),
        (
            {"reward": lambda step: torch.full((3,), 1e300, dtype=torch.float64)},  # finite, but not in float32
            "reward=<lambda> returned numbers that are not finite",
        ),
        ({"vector": lambda state: state.time[:, None][:, :0]}, r"shape \(3, 0\): must be \(3, V\)"),
        ({"vector": lambda state: state.time[:, None] / 0}, "vector=<lambda> returned numbers that are not finite"),
        ({"vector": uneven()}, r"shape \(3, 3\): must be \(3, 2\), 2 numbers"),
        ({"vector": OWN["gate_and_action"], "imu": "exact", "from_pixels": True}, "imu= and vector= cannot be"),
    ],
)  # fmt: skip
def test_bad_functions_are_refused(own: dict[str, Any], message: str) -> None:
    def use() -> None:
        env = DroneRacingEnv("circle", **SMALL | own)
        env.rollout(2)

    with pytest.raises(ValueError, match=message):
        use()


def test_a_gpu_is_asked_only_where_it_waits_anyway() -> None:
    own = CustomFunction("reward", lambda step: step, 2, torch.device("cpu"))
    own.check()
    own._broken.fill_(True)
    with pytest.raises(ValueError, match="returned numbers that are not finite"):
        own.check()


@pytest.mark.gpu
def test_own_functions_are_captured_as_a_graph() -> None:
    small = SMALL | {"device": "cuda"}
    own = DroneRacingEnv("circle", **small, reward=OWN["smooth"], vector=OWN["gate_and_action"])
    plain = DroneRacingEnv("circle", **small)
    for env in (own, plain):
        env.worlds.reset()
    paid, default = ([env.worlds.step(action).reward_base for action in ACTIONS.cuda()] for env in (own, plain))
    change = ACTIONS.cuda().clamp(-1.0, 1.0).diff(dim=0).square().sum(-1)
    torch.testing.assert_close(paid[0], default[0])
    for step in range(1, len(paid)):
        torch.testing.assert_close(paid[step], default[step] - 0.05 * change[step - 1])
    assert own.rollout(4, break_when_any_done=False)["vector"].shape == (3, 4, 5)
    bad = RaceWorlds("circle", **small, reward=lambda step: step.default_reward / 0)
    bad.reset()
    bad.step(ACTIONS[0].cuda())
    with pytest.raises(ValueError, match="returned numbers that are not finite"):
        bad.reset()


@pytest.mark.gpu
def test_a_reward_that_waits_is_refused_on_a_gpu() -> None:
    def waits(step: Transition) -> Tensor:
        return step.default_reward * (2.0 if step.default_reward.sum().item() > 0 else 1.0)

    worlds = RaceWorlds("circle", **SMALL | {"device": "cuda"}, reward=waits)
    worlds.reset()
    with pytest.raises(RuntimeError, match="cannot be captured as a CUDA graph"):
        worlds.step(ACTIONS[0].cuda())


def test_an_error_of_the_function_itself_is_told_as_one() -> None:
    def unpacks(step: Transition) -> Tensor:
        rewards, _ = step.default_reward
        return rewards

    with pytest.raises(RuntimeError, match="reward=unpacks failed: too many values to unpack"):
        fly(reward=unpacks)


def test_what_a_function_keeps_is_not_what_was_seen() -> None:
    kept = torch.zeros(SMALL["num_envs"], 1)
    worlds, _ = fly(vector=lambda state: kept)
    seen = worlds.observed_vector()
    kept += 1.0
    assert not seen.any()


def test_states_are_copies() -> None:
    worlds, _ = fly(vector=OWN["gate_and_action"])
    state = worlds.race_state()
    before = replace(state, position=state.position.clone(), action=state.action.clone())
    worlds.step(ACTIONS[1])
    assert isinstance(state, RaceState)
    assert torch.equal(state.position, before.position) and torch.equal(state.action, before.action)


def test_the_example_rewards_a_camera_that_looks_at_the_gate(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "examples" / "rewards"))
    pitch = math.radians(25.0)  # nose down, so that the camera, which looks 25 degrees up, looks level along x
    attitude = torch.tensor([[math.cos(pitch / 2), 0.0, math.sin(pitch / 2), 0.0]]).expand(3, 4)
    gates = torch.tensor([[5.0, 0.0, 0.0], [-5.0, 0.0, 0.0], [0.0, 5.0, 0.0]])
    after = SimpleNamespace(position=torch.zeros(3, 3), attitude=attitude, gate_position=gates)
    rewards = importlib.import_module("looking").looking(SimpleNamespace(after=after, default_reward=torch.ones(3)))
    torch.testing.assert_close(rewards, torch.tensor([1.3, 0.7, 1.0]))
    _, plain = fly()
    _, looking = fly(reward="looking:looking")
    assert not torch.equal(plain[0], looking[0]) and (plain[0] - looking[0]).abs().max() <= 0.3 + 1e-6
