"""Starts before crashes, on states made by hand."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from dreamer_racing.envs import DroneRacingEnv
from dreamer_racing.envs.race.crash_memory import CrashMemory
from dreamer_racing.envs.race.starts import StartPose
from dreamer_racing.envs.simulator.base import DroneState

DT = 0.1  # s, so that 0.4-2 s are 4 to 20 control steps


def state(step: int, num: int) -> DroneState:
    """All drones at (step, drone, 1) with velocity (step, 0, 0)."""
    at = torch.stack([torch.tensor([float(step), float(drone), 1.0]) for drone in range(num)])
    attitude = torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(num, 4)
    velocity = torch.tensor([float(step), 0.0, 0.0]).expand(num, 3)
    return DroneState(position=at, attitude=attitude, linear_velocity=velocity, body_rates=torch.zeros(num, 3))


def start(num: int) -> StartPose:
    attitude = torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(num, 4)
    return StartPose(torch.full((num, 3), -1.0), attitude, torch.zeros(num, 3), torch.zeros(num, dtype=torch.int64))


def fly(memory: CrashMemory, steps: int, crashed: Tensor) -> None:
    """Fly all drones for some steps, to gate number ``step``; the last step is the crash."""
    num = len(crashed)
    for step in range(1, steps + 1):
        ends = crashed if step == steps else torch.zeros(num, dtype=torch.bool)
        memory.note(state(step, num), torch.full((num,), step), ends)


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def test_episodes_begin_where_a_drone_was_before_its_crash(generator):
    memory = CrashMemory(64, 0.999, DT, "cpu", torch.float32)
    fly(memory, 50, torch.ones(64, dtype=torch.bool))
    pose = memory.begin(torch.ones(64, dtype=torch.bool), start(64), generator)
    steps = pose.position[:, 0]
    assert steps.min() == 30 and steps.max() == 46  # 20 to 4 before the 50th
    torch.testing.assert_close(pose.linear_velocity[:, 0], steps)
    torch.testing.assert_close(pose.target_gate, steps.long())
    assert len(pose.position[:, 1].unique()) > 30  # of all drones


def test_nothing_is_left_by_who_did_not_crash_flew_too_short_or_began_so(generator):
    memory = CrashMemory(4, 0.999, DT, "cpu", torch.float32)
    everyone = torch.ones(4, dtype=torch.bool)
    fly(memory, 50, ~everyone)
    assert (memory.begin(everyone, start(4), generator).position == -1.0).all() and not memory.filled.any()
    fly(memory, 4, everyone)  # 0.4 s before is the start itself, which is no step
    memory.begin(everyone, start(4), generator)
    assert not memory.filled.any()
    fly(memory, 10, torch.tensor([True, False, False, False]))
    memory.begin(everyone, start(4), generator)
    assert memory.filled.tolist() == [True, False, False, False]
    assert memory.state[0, 0] in range(1, 7)
    kept = memory.state.clone()
    memory.again.fill_(True)
    fly(memory, 50, everyone)
    memory.begin(everyone, start(4), generator)
    assert (memory.state == kept).all()


def test_the_share_is_kept_and_others_begin_as_they_would(generator):
    memory = CrashMemory(2000, 0.3, DT, "cpu", torch.float32)
    fly(memory, 50, torch.ones(2000, dtype=torch.bool))
    pose = memory.begin(torch.ones(2000, dtype=torch.bool), start(2000), generator)
    again = pose.position[:, 0] > 0
    assert again.float().mean().item() == pytest.approx(0.3, abs=0.04)
    assert (again == memory.again).all() and (pose.position[~again] == -1.0).all()


@pytest.mark.parametrize("share", [-0.1, 1.0])
def test_a_share_that_is_none_is_refused(share):
    with pytest.raises(ValueError, match=f"start_before_crash={share}: a share of episodes"):
        DroneRacingEnv("circle", 1, from_pixels=False, start_before_crash=share)


def test_an_environment_goes_on_with_its_memory(tmp_path):
    def make() -> DroneRacingEnv:
        return DroneRacingEnv("circle", 8, from_pixels=False, seed=3, start_before_crash=0.5, control_rate=25)

    def fly_on(env: DroneRacingEnv, steps: int, seed: int) -> Tensor:
        torch.manual_seed(seed)
        path, tensordict = [], env.reset() if seed == 0 else env._carried
        for _ in range(steps):
            tensordict["action"] = torch.cat((torch.rand(8, 1) * 0.4 - 0.3, torch.randn(8, 3) * 0.05), 1).clamp(-1, 1)
            _, tensordict = env.step_and_maybe_reset(tensordict)
            path.append(tensordict["privileged", "position"].clone())
        env._carried = tensordict
        return torch.stack(path)

    env, other = make(), make()
    fly_on(env, 150, 0)
    assert env.worlds._crashes.filled.any()
    fly_on(other, 10, 0)
    other.load_state_dict(env.state_dict())
    other._carried = env._carried.clone()
    torch.testing.assert_close(fly_on(env, 150, 1), fly_on(other, 150, 1), rtol=0, atol=0)
    older = env.state_dict()
    del older["worlds"]["crashes"]
    begun = make()
    begun.load_state_dict(older)  # of a version without, its episodes under way
    begun._carried = env._carried.clone()
    fly_on(begun, 150, 1)
    left = begun.worlds._crashes
    assert left.filled.any()
    torch.testing.assert_close(left.state[left.filled, 3:7].norm(dim=-1), torch.ones(int(left.filled.sum())).double())


def test_evaluation_begins_at_the_start_pose():
    env = DroneRacingEnv("circle", 2, from_pixels=False, evaluation=True, start_before_crash=0.9)
    assert env.worlds._crashes is None
