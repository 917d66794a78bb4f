"""An environment restored from its state goes on exactly as the one it was taken from."""

from __future__ import annotations

import io

import pytest
import torch
from tensordict import TensorDict

from dreamer_racing.envs import DroneRacingEnv


def through_a_file(state: dict) -> dict:
    file = io.BytesIO()
    torch.save(state, file)
    file.seek(0)
    return torch.load(file, weights_only=True)


@pytest.mark.parametrize(("preset", "looks"), [("easy", None), ("faithful", None), ("faithful", "randomised")])
def test_restored_worlds_go_on_bit_for_bit(preset: str, looks: str | None) -> None:
    def make(seed: int) -> DroneRacingEnv:
        return DroneRacingEnv(
            "circle", 6, from_pixels=looks is not None, preset=preset, seed=seed, episode_steps=30, looks=looks
        )

    torch.manual_seed(0)
    env, other = make(1), make(2)
    env.rollout(25, break_when_any_done=False)
    other.rollout(3, break_when_any_done=False)
    env.body_rate_weight = 0.004
    other.load_state_dict(through_a_file(env.state_dict()))
    assert other.body_rate_weight == 0.004
    root = TensorDict({}, [6])  # neither is observed here: images have noise from the generator
    for _ in range(60):  # past the end of every episode: resets draw from the restored generator
        action = torch.rand(6, 4) * 2 - 1
        steps = [each.step(root.clone().set("action", action))["next"] for each in (env, other)]
        assert (steps[0] == steps[1]).all()
        if steps[0]["done"].any():
            resets = [each.reset(root.clone().set("_reset", steps[0]["done"])) for each in (env, other)]
            assert (resets[0] == resets[1]).all()


def test_a_state_of_another_number_of_worlds_is_refused() -> None:
    env, other = (DroneRacingEnv("circle", n, from_pixels=False, seed=0) for n in (2, 3))
    with pytest.raises(ValueError, match="2 worlds, these are 3: resume with num_envs=2"):
        other.load_state_dict(env.state_dict())


def test_a_state_of_another_device_is_refused() -> None:
    env = DroneRacingEnv("circle", 2, from_pixels=False, seed=0)
    state = env.state_dict()
    state["worlds"]["generator"] = torch.zeros(16, dtype=torch.uint8)  # as a CUDA generator's
    with pytest.raises(ValueError, match="worlds on cuda, these are on cpu.*env.device=cuda"):
        env.load_state_dict(state)
