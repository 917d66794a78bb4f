"""Parts of an export: the file of weights, actors with an IMU, and how long they take."""

from __future__ import annotations

import json
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
import torch

from dreamer_racing.envs.imu import IMUS
from dreamer_racing.envs.simulator.scene import Camera
from dreamer_racing.envs.torchrl_env import DroneRacingEnv
from dreamer_racing.export.actor_step import export_actor, make_step
from dreamer_racing.export.contract import make_contract
from dreamer_racing.export.onnx_actor import CONTRACT, OnnxActor, read_contract
from dreamer_racing.export.parity import MIN_STEPS, RecordedFlight, TorchActor, episode_steps, record_flight
from dreamer_racing.export.weights_file import read_weights, write_weights
from dreamer_racing.hil.camera import camera_of
from dreamer_racing.hil.flyer import ActorFlyer
from dreamer_racing.modules import Agent, Interface, get_size
from tests.export.recorded import make_agent
from tests.forked import program
from tests.running_recipes import ROOT, recipe_module

WEIGHTS = {"b": torch.tensor([[1.0, -2.0], [0.5, 3e-8]]), "a": torch.tensor(7.0), "empty": torch.zeros(0, 3)}


def test_the_bytes_by_hand(tmp_path: Path) -> None:
    extents = write_weights(tmp_path / "weights", WEIGHTS)
    content = (tmp_path / "weights").read_bytes()
    first = 8 + int.from_bytes(content[:8], "little")
    assert first % 8 == 0 and json.loads(content[8:first]) == {
        "a": {"dtype": "F32", "shape": [], "data_offsets": [0, 4]},
        "b": {"dtype": "F32", "shape": [2, 2], "data_offsets": [4, 20]},
        "empty": {"dtype": "F32", "shape": [0, 3], "data_offsets": [20, 20]},
    }
    assert content[first:] == np.array([7, 1, -2, 0.5, 3e-8], "<f4").tobytes()
    assert extents == {"a": (first, 4), "b": (first + 4, 16), "empty": (first + 20, 0)}


def test_what_is_written_is_read(tmp_path: Path) -> None:
    transposed = {**WEIGHTS, "c": torch.arange(6.0).reshape(2, 3).T}
    write_weights(tmp_path / "weights", transposed)
    read = read_weights(tmp_path / "weights")
    assert read.keys() == transposed.keys()
    assert all(torch.equal(read[name], value) for name, value in transposed.items())
    read["a"] += 1.0  # the memory is its own


def test_other_types_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="half is torch.float16: only float32"):
        write_weights(tmp_path / "weights", {"half": torch.zeros(1, dtype=torch.float16)})
    text = b'{"x":{"dtype":"F16","shape":[1],"data_offsets":[0,2]}}'
    (tmp_path / "half").write_bytes(len(text).to_bytes(8, "little") + text + b"00")
    with pytest.raises(ValueError, match=r"half is not a complete safetensors file .*F16"):
        read_weights(tmp_path / "half")


@pytest.mark.parametrize("keep", [0, 6, 40, -1], ids=["nothing", "length", "header", "tensors"])
def test_a_file_that_was_cut_off_is_refused(keep: int, tmp_path: Path) -> None:
    write_weights(tmp_path / "weights", WEIGHTS)
    (tmp_path / "weights").write_bytes((tmp_path / "weights").read_bytes()[:keep])
    with pytest.raises(ValueError, match="weights is not a complete safetensors file"):
        read_weights(tmp_path / "weights")


# An agent with a slow camera and an IMU: seen in training, exported, and flown the same by every copy.


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
    assert flight.observations.shape == (MIN_STEPS, 32, 32, 3) and flight.imu.shape == (MIN_STEPS, 6)
    assert flight.is_init[0] and flight.episodes >= 4
    same = (flight.observations[1:] == flight.observations[:-1]).all((1, 2, 3))
    within = ~flight.is_init[1:]
    assert 0.45 < same[within].mean() < 0.6
    later = within[1:] & within[:-1]  # a sample is a step old, and none is older than its episode
    assert (np.diff(flight.imu, axis=0) != 0).any(1)[1:][later].all()


@pytest.mark.parametrize(("latent", "parts"), [("mode", True), ("sample", False)])
def test_every_copy_flies_as_the_policy_did(flown, latent: str, parts: bool, tmp_path: Path) -> None:
    pytest.importorskip("onnxscript")
    pytest.importorskip("onnxruntime")
    agent, flight, env = flown
    step = make_step(agent, latent)
    contract = make_contract(step, env.worlds.parameters, env.worlds.camera, IMUS["noisy"])
    deviation = export_actor(step, contract, flight, tmp_path / "actor.onnx", parts=parts)
    assert max(deviation.values()) < 1e-4
    written = read_contract(tmp_path / CONTRACT)
    assert written["format_version"] == 2
    assert camera_of(written) == Camera(32, 32, rate=25.0)
    assert [channel["unit"] for channel in written["imu"]["channels"]] == ["rad/s"] * 3 + ["m/s^2"] * 3
    assert written["imu"]["trained_errors"] == vars(IMUS["noisy"])
    actor = OnnxActor(tmp_path / "actor.onnx", seed=0)
    assert actor.needs_imu and actor.in_parts is parts
    image, sample = flight.observations[0], flight.imu[0]
    first = actor.step(image, imu=sample)
    actor.reset()
    assert not np.array_equal(first, actor.step(image, imu=sample + 1.0)), "the IMU counts"
    with pytest.raises(ValueError, match="imu: got NoneType, but this actor takes a numpy array float32 of shape"):
        actor.step(image)
    with pytest.raises(ValueError, match="imu: contains numbers that are not finite"):
        actor.step(image, imu=sample * np.float32("nan"))


def test_an_actor_without_one_takes_none() -> None:
    step = make_step(make_agent(interface=Interface(image_size=32)), "mode")
    assert "imu" not in step.example_inputs()
    env = DroneRacingEnv("circle", 1, from_pixels=False)
    contract = make_contract(step, env.worlds.parameters, CAMERA)
    assert contract["format_version"] == 1 and "imu" not in contract and "rate_hz" not in contract["camera"]
    with pytest.raises(ValueError, match="imu: by its contract, this actor takes none"):
        TorchActor(contract, step).step(np.zeros((32, 32, 3), np.uint8), imu=np.zeros(6, np.float32))


# `benchmarks/actor_latency.py`: sizes with initial weights are exported, timed, and fly in the loop like any other.


@pytest.mark.slow
def test_a_size_is_exported_timed_and_taken_by_the_loop(tmp_path):
    script, folder = ROOT / "benchmarks" / "actor_latency.py", tmp_path / "exports"
    options = ["--sizes", "debug", "--actors", "circle", "--steps", "20", "--keep", str(folder)]
    ended = program(script, *options, "--json", str(tmp_path / "latency.json"), cwd=tmp_path)
    assert ended.returncode == 0, ended.stderr
    records = json.loads((tmp_path / "latency.json").read_text())
    assert [record["actor"] for record in records] == ["circle", "debug"]
    for record in records:
        assert 0.0 < record["p50_ms"] <= record["p99_ms"] <= record["max_ms"] and record["threads"] == 1
    assert ActorFlyer(folder / "debug").rate == 50.0
    hil = recipe_module("hil")
    config = hil.HilConfig(actor=str(folder / "debug"), run_dir=str(tmp_path / "run"), record=False, pose_port=9127)
    with ExitStack() as opened:
        assert hil.prepare(config, opened).chain.safety.armed is False
