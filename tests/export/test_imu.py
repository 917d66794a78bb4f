"""An agent with a slow camera and an IMU: seen in training, exported, and flown the same by every copy."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from dreamer_racing.envs.imu import IMUS
from dreamer_racing.envs.simulator.scene import Camera
from dreamer_racing.envs.torchrl_env import DroneRacingEnv
from dreamer_racing.export.actor_step import LATENTS, export_actor, make_step
from dreamer_racing.export.contract import make_contract
from dreamer_racing.export.onnx_actor import CONTRACT, OnnxActor, read_contract
from dreamer_racing.export.parity import MIN_STEPS, RecordedFlight, TorchActor, episode_steps, record_flight
from dreamer_racing.hil.camera import camera_of
from dreamer_racing.modules import Interface, get_size
from dreamer_racing.modules.agent import Agent

CAMERA = Camera(32, 32)


@pytest.fixture(scope="module")
def flown() -> tuple[Agent, RecordedFlight, DroneRacingEnv]:
    torch.manual_seed(0)
    env = DroneRacingEnv("circle", 1, control_rate=50.0, camera_rate=25.0, imu="noisy", camera=CAMERA, seed=0,
                         episode_steps=episode_steps(MIN_STEPS), num_threads=1)  # fmt: skip
    agent = Agent(get_size("debug"), Interface.of(env), decode=False)
    with torch.no_grad():
        for parameter in agent.parameters():  # those at their start hardly react to what they see
            parameter.add_(0.1 * torch.randn_like(parameter))
    agent.requires_grad_(False)
    flight = record_flight(env, agent, MIN_STEPS)
    env.close()
    return agent, flight, env


def test_the_agent_sees_the_image_that_is_held_and_the_newest_sample(flown) -> None:
    agent, flight, _ = flown
    assert agent.interface.observation_keys == ["pixels", "imu"]
    assert flight.imu is not None and flight.imu.shape == (MIN_STEPS, 6)
    same = [
        np.array_equal(one, other) for one, other in zip(flight.observations, flight.observations[1:], strict=False)
    ]
    within = ~flight.is_init[1:]
    assert 0.45 < np.mean(np.array(same)[within]) < 0.6
    later = within[1:] & within[:-1]  # a sample is a step old, and none is older than its episode
    assert (np.diff(flight.imu, axis=0) != 0).any(1)[1:][later].all()


@pytest.mark.parametrize(("latent", "parts"), [("mode", True), ("sample", False)])
def test_every_copy_flies_as_the_policy_did(flown, latent: str, parts: bool, tmp_path: Path) -> None:
    pytest.importorskip("onnxscript")
    pytest.importorskip("onnxruntime")
    agent, flight, env = flown
    step = make_step(agent, latent)
    assert set(LATENTS) == {"mode", "sample"}
    contract = make_contract(step, env.worlds.parameters, env.worlds.camera, IMUS["noisy"])
    deviation = export_actor(step, contract, flight, tmp_path / "actor.onnx", parts=parts)
    assert max(deviation.values()) < 1e-4
    written = read_contract(tmp_path / CONTRACT)
    assert written["format_version"] == 2
    assert camera_of(written) == Camera(32, 32, rate=25.0)
    assert [channel["unit"] for channel in written["imu"]["channels"]] == ["rad/s"] * 3 + ["m/s^2"] * 3
    assert written["imu"]["trained_errors"] == vars(IMUS["noisy"])
    actor = OnnxActor(tmp_path / "actor.onnx", seed=0)
    assert actor.feels and actor.in_parts is parts
    image, sample = flight.observations[0], flight.imu[0]
    first = actor.step(image, imu=sample)
    actor.reset()
    assert not np.array_equal(first, actor.step(image, imu=sample + 1.0)), "the IMU counts"
    with pytest.raises(ValueError, match="imu: got NoneType, but this actor takes a numpy array float32 of shape"):
        actor.step(image)
    with pytest.raises(ValueError, match="imu: contains numbers that are not finite"):
        actor.step(image, imu=sample * np.float32("nan"))


def test_an_actor_without_one_takes_none() -> None:
    agent = Agent(get_size("debug"), Interface(image_size=32), decode=False).requires_grad_(False)
    step = make_step(agent, "mode")
    assert "imu" not in step.example_inputs()
    env = DroneRacingEnv("circle", 1, from_pixels=False)
    contract = make_contract(step, env.worlds.parameters, CAMERA)
    assert contract["format_version"] == 1 and "imu" not in contract and "rate_hz" not in contract["camera"]
    with pytest.raises(ValueError, match="imu: this actor has none"):
        TorchActor(contract, step).step(np.zeros((32, 32, 3), np.uint8), imu=np.zeros(6, np.float32))
    with pytest.raises(ValueError, match="sees pixels and vector; beside images only an IMU"):
        make_step(Agent(get_size("debug"), Interface(image_size=32, vector_dim=5), decode=False), "mode")
