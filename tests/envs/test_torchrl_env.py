"""`DroneRacingEnv`: TorchRL's conformance, and what each key of `docs/api/environments.md` promises."""

import gc
import resource
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

from dreamer_racing.envs.drone.parameters import QuadrotorParameters
from dreamer_racing.envs.race.gates import CrashCause
from dreamer_racing.envs.race.pilot import PilotPolicy, ScriptedPilot
from dreamer_racing.envs.race.race import RewardWeights
from dreamer_racing.envs.torchrl_env import DroneRacingEnv
from dreamer_racing.envs.tracks import BUILTIN_TRACKS, TrackError, load_track

HOVER = (QuadrotorParameters().hover_action, 0.0, 0.0, 0.0)
STATM = Path("/proc/self/statm")


def blind(num_envs: int = 3, track="circle", **arguments) -> DroneRacingEnv:
    """An environment without pixels."""
    return DroneRacingEnv(track, num_envs, from_pixels=False, **{"seed": 0, **arguments})


def hover(data: TensorDict) -> TensorDict:
    return data.set("action", torch.tensor(HOVER).expand(*data.batch_size, 4).clone())


def wild(seed: int):
    """A policy of random actions near hover."""
    generator = torch.Generator().manual_seed(seed)

    def act(data: TensorDict) -> TensorDict:
        noise = torch.rand(*data.batch_size, 4, generator=generator) - 0.5
        return data.set("action", torch.tensor(HOVER) + noise)

    return act


@pytest.mark.parametrize("track", BUILTIN_TRACKS)
def test_specs_on_every_track(track: str) -> None:
    for env in (DroneRacingEnv(track, num_envs=2, seed=0), blind(1, track, preset="faithful")):
        check_env_specs(env)
        env.close()


@pytest.mark.parametrize(("from_pixels", "privileged"), [(False, False), (False, True), (True, False), (True, True)])
def test_specs_with_and_without_pixels_and_state(from_pixels: bool, privileged: bool) -> None:
    env = DroneRacingEnv("kidney", num_envs=2, from_pixels=from_pixels, privileged=privileged, seed=0)
    check_env_specs(env)
    data = env.rollout(3)
    keys = data["next"].keys()
    assert ("pixels" in keys, "privileged" in keys) == (from_pixels, privileged)
    for key, dtype, shape in (
        ("action", torch.float32, (4,)),
        (("next", "reward"), torch.float32, (1,)),
        (("next", "terminated"), torch.bool, (1,)),
        (("next", "reward_base"), torch.float32, (1,)),
        (("next", "race", "gates_passed"), torch.int64, (1,)),
        (("next", "race", "finished"), torch.bool, (1,)),
    ):
        assert (data[key].dtype, data[key].shape[2:]) == (dtype, shape), key
    if from_pixels:
        assert (data["pixels"].dtype, data["pixels"].shape[2:]) == (torch.uint8, (64, 64, 3))
    if privileged:
        assert data["privileged", "target_gate"].dtype == torch.int64
        assert data["privileged", "attitude"].shape[2:] == (4,)
    env.close()


def test_seeds_reproduce_and_differ() -> None:
    def fly(seed: int) -> torch.Tensor:
        env = blind(preset="faithful", seed=seed)
        data = torch.cat([env.rollout(5, wild(0)), env.rollout(5, wild(1))], dim=1)
        return data["next", "privileged", "position"]

    first = fly(0)
    assert torch.equal(first, fly(0))
    assert not torch.allclose(first, fly(1))
    assert not torch.allclose(first[:, 0], first[:, 5])


def test_set_seed_starts_over() -> None:
    env = blind()
    starts = []
    for _ in range(2):
        env.set_seed(11)
        starts.append(env.reset()["privileged", "position"])
    assert torch.equal(*starts)
    assert not torch.equal(starts[0], env.reset()["privileged", "position"])


def test_time_limit_truncates_and_nothing_else() -> None:
    env = blind(evaluation=True, episode_steps=4)
    data = env.rollout(4, hover, break_when_any_done=False)
    for key, expected in (("truncated", [0, 0, 0, 1]), ("done", [0, 0, 0, 1]), ("terminated", [0, 0, 0, 0])):
        assert data["next", key][..., 0].tolist() == [[bool(value) for value in expected]] * 3
    assert (data["next", "race", "crash"] == CrashCause.NONE).all()


def test_crash_terminates_and_is_not_truncated() -> None:
    env = blind(evaluation=True)
    data = env.rollout(100, lambda *observation: torch.tensor([-1.0, 0, 0, 0]).repeat(3, 1))
    last = data[:, -1]["next"]
    assert last["terminated"].all()
    assert last["done"].all()
    assert not data["next", "truncated"].any()
    assert not data["next", "terminated"][:, :-1].any()
    assert (last["race", "crash"] == CrashCause.GROUND).all()
    assert (last["reward"] == -4.0).all()


def test_evaluation_finishes_after_the_laps() -> None:
    env = blind(1, replace(load_track("circle"), laps=1), evaluation=True)
    data = env.rollout(400, PilotPolicy(ScriptedPilot(env.track)))
    last = data[0, -1]["next"]
    assert last["race", "finished"].item()
    assert last["race", "gates_passed"].item() == 4
    assert (last["truncated"].item(), last["terminated"].item()) == (True, False)
    assert last["race", "lap_time"].item() == pytest.approx(0.02 * data.shape[1])
    assert last["reward"].item() == 10.0
    passed = data["next", "race", "gates_passed"][0, :, 0].diff().nonzero()
    assert (data["next", "race", "gate_offset"][0, passed + 1] > 0).all()
    assert data["next", "privileged", "target_gate"][0, -1].item() == 0


def test_reward_is_split_and_follows_todays_weight() -> None:
    env = blind(weights=RewardWeights(body_rate=0.25))
    assert env.body_rate_weight == 0.25
    for weight in (0.25, 0.01):
        env.body_rate_weight = weight
        after = env.rollout(4, wild(0))["next"]
        assert (after["body_rate_norm"] > 0).any()
        torch.testing.assert_close(after["reward"], after["reward_base"] - weight * after["body_rate_norm"])


def test_first_observation_of_an_episode() -> None:
    env = DroneRacingEnv("circle", 2, seed=0)
    data = env.reset()
    assert not data["done"].any()
    assert not data["reward_base"].any()
    assert all(not value.any() for value in data["race"].values())
    assert data["pixels"].float().std() > 10
    env.close()


def test_partial_reset_leaves_the_others_untouched() -> None:
    env = DroneRacingEnv("circle", 3, seed=0)
    before = env.rollout(3, wild(0), break_when_any_done=False)[:, -1]["next"]
    mask = torch.tensor([[False], [True], [False]])
    rows = mask[:, 0]
    after = env.reset(before.clone().set("_reset", mask))
    for name in ("position", "attitude", "linear_velocity", "body_rates", "target_gate"):
        same = (after["privileged", name] == before["privileged", name]).all(-1)
        assert same[~rows].all(), name
    assert (after["privileged", "position"][rows] != before["privileged", "position"][rows]).any()
    assert not after["privileged", "body_rates"][rows].any()

    flown = env.step(hover(after.clone()))["next"]
    undisturbed = DroneRacingEnv("circle", 3, seed=0)
    data = undisturbed.rollout(3, wild(0), break_when_any_done=False)[:, -1]["next"]
    expected = undisturbed.step(hover(data.select("privileged")))["next"]
    for key in ("reward", "pixels", ("privileged", "position"), ("race", "gates_passed")):
        assert torch.equal(flown[key][~rows], expected[key][~rows]), key
    env.close()
    undisturbed.close()


def test_invalid_action_ends_only_its_own_environment() -> None:
    runs = []
    for poison in (False, True):
        env = DroneRacingEnv("circle", 3, seed=0)
        data, rows = env.reset(), []
        for step in range(4):
            data = wild(step)(data)
            if poison and step == 1:
                data["action"][1, 2] = torch.nan
            data = env.step(data)["next"]
            rows.append(data.clone())
        runs.append(torch.stack(rows, dim=1))
        env.close()
    clean, poisoned = runs
    others = torch.tensor([True, False, True])
    for key in clean.keys(include_nested=True, leaves_only=True):
        assert torch.equal(clean[key][others], poisoned[key][others]), key
    hit = poisoned[1, 1]
    assert (hit["terminated"].item(), hit["reward"].item()) == (True, -4.0)
    assert hit["race", "crash"].item() == CrashCause.INVALID_ACTION
    assert hit["privileged", "position"].isfinite().all()


@pytest.mark.parametrize(
    ("action", "error", "words"),
    [
        (torch.zeros(3, 3), ValueError, r"Action of shape \(3, 3\): must be \(3, 4\), for 3 environment\(s\)"),
        (torch.zeros(3, 4, dtype=torch.int64), TypeError, "Action of torch.int64: thrust and body rates are floating"),
    ],
)
def test_wrong_actions_are_explained(action: torch.Tensor, error: type[Exception], words: str) -> None:
    env = blind()
    data = env.reset()
    with pytest.raises(error, match=words):
        env.step(data.set("action", action))


def test_actions_beyond_the_bounds_are_clipped() -> None:
    ends = []
    for scale in (1.0, 7.0):
        env = blind(evaluation=True)
        data = env.reset().set("action", scale * torch.tensor([[1.0, -1.0, 1.0, 1.0]]).repeat(3, 1))
        ends.append(env.step(data)["next", "privileged", "attitude"])
    assert torch.equal(*ends)


@pytest.mark.parametrize(
    ("argument", "words"),
    [
        ({"num_envs": 0}, "num_envs=0: at least one world"),
        ({"num_envs": 2.5}, "num_envs=2.5: must be a whole number"),
        ({"track": "kidny"}, "kidny"),  # a `TrackError`
        ({"episode_steps": "100"}, "episode_steps='100': must be a whole number"),
        ({"control_rate": "50"}, "control_rate='50': must be a number"),
        ({"start_noise": "much"}, "start_noise='much': must be a number"),
        ({"seed": -1}, "seed=-1: must be at least 0"),
        ({"seed": 2**70}, "seed=1180591620717411303424: must be at least 0 and below 2..63"),
        ({"camera": "wide"}, "camera='wide': must be a Camera"),
    ],
)
def test_bad_arguments_are_named(argument: dict[str, object], words: str) -> None:
    with pytest.raises(TrackError if "track" in argument else ValueError, match=words):
        blind(**argument)


def test_numbers_of_numpy_are_numbers() -> None:
    env = blind(num_envs=np.int64(2), seed=np.uint32(3), control_rate=np.float32(50), miss_radius=np.int32(3))
    assert env.batch_size == (2,)


def test_a_closed_environment_has_freed_its_renderer():
    env = DroneRacingEnv("circle", num_envs=2, seed=0)
    assert not env.is_closed
    env.reset()
    env.close()
    assert env.is_closed
    with pytest.raises(RuntimeError, match="it is closed"):
        env.reset()
    env.close(raise_if_closed=False)


@pytest.mark.slow
def test_environments_made_and_closed_leave_nothing_behind():
    """A renderer holds 7 MiB; the limit is 0.05 MB a cycle, above the 0.03 by which memory fragments."""
    if not STATM.exists():
        pytest.skip("how much memory this process has is read from /proc")

    def cycle() -> int:
        env = DroneRacingEnv("circle", num_envs=2, seed=0)
        env.reset()
        env.close()
        gc.collect()
        return int(STATM.read_text().split()[1]) * resource.getpagesize()

    gc.collect()
    gc.freeze()  # what torch brings is not looked through after every cycle
    before = [cycle() for _ in range(15)][-1]
    after = [cycle() for _ in range(60)][-1]
    gc.unfreeze()
    assert after - before < 60 * 0.05e6
