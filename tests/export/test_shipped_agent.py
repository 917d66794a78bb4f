"""The agent that flies: which weights of a checkpoint, and out of a folder that ships as it was in training."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from dreamer_racing.envs.simulator.scene import Camera
from dreamer_racing.envs.torchrl_env import DroneRacingEnv
from dreamer_racing.export.actor_step import ActorStep, export_actor
from dreamer_racing.export.contract import hash_weights, make_contract
from dreamer_racing.export.onnx_actor import CONTRACT, OnnxActor, read_contract
from dreamer_racing.export.shipped_agent import FILES, ShippedAgent, check_env, choose_weights, is_agent, load_agent
from dreamer_racing.export.weights_file import read_weights, write_weights
from dreamer_racing.modules import Interface
from dreamer_racing.training.checkpoint import RunCheckpoints
from tests.dreamers import learner_of
from tests.export.recorded import make_agent, make_flight

pytestmark = pytest.mark.xdist_group("shipped")  # one worker makes what these tests share

WORLDS = {"track": "circle", "num_envs": 1, "camera": Camera(32, 32, tilt=30.0), "control_rate": 25.0, "num_threads": 1}
SMALL = Interface(image_size=32)


@pytest.fixture(scope="module")
def env():
    env = DroneRacingEnv(**WORLDS)
    yield env
    env.close()


@pytest.fixture(scope="module")
def shipped(env: DroneRacingEnv, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of an agent."""
    pytest.importorskip("onnxscript")
    pytest.importorskip("onnxruntime")
    agent, folder = make_agent(interface=SMALL), tmp_path_factory.mktemp("agents") / "round"
    step, flight = ActorStep(agent), make_flight(agent)
    contract = make_contract(step, env.worlds.parameters, env.worlds.camera)
    export_actor(step, contract, flight, folder / "actor.onnx", shared_weights=True)
    (folder / "config.yaml").write_text("track: circle\n")
    (folder / "agent.json").write_text('{"weights": "averaged"}')
    return folder


# --- out of a checkpoint ----------------------------------------------------------------------------------------------


def test_the_choice_of_weights() -> None:
    both = ("averaged", "trained")
    assert [choose_weights(wanted, both, "x") for wanted in ("auto", *both)] == ["averaged", *both]
    assert choose_weights("auto", "trained", "x") == "trained"
    with pytest.raises(ValueError, match="^weights=averaged: runs/x holds the trained weights only"):
        choose_weights("averaged", "trained", "runs/x")
    with pytest.raises(ValueError, match="weights=best: must be one of auto, averaged, trained"):
        choose_weights("best", both, "x")


def test_the_averaged_weights_fly_where_they_are_kept(tmp_path: Path) -> None:
    learner = learner_of(seed=1, average_rate=0.1)
    for parameter in learner.averaged.parameters():
        parameter.add_(1.0)
    RunCheckpoints(tmp_path, {"learner": learner}).save(env_steps=40)
    hashes = {}
    for weights in ("auto", "averaged", "trained"):
        agent, metadata = load_agent(tmp_path, Interface(), weights)
        hashes[weights] = hash_weights(ActorStep(agent))
        assert metadata["weights"] == ("averaged" if weights == "auto" else weights)
    assert hashes["auto"] == hashes["averaged"] == hash_weights(ActorStep(learner.evaluation_agent))
    assert hashes["trained"] == hash_weights(ActorStep(learner.agent)) != hashes["averaged"]


def test_an_agent_is_restored_whatever_its_losses_were(tmp_path: Path) -> None:
    learner = learner_of(seed=1)
    RunCheckpoints(tmp_path, {"learner": learner}).save(env_steps=40)
    agent, metadata = load_agent(tmp_path, Interface())
    assert metadata["env_steps"] == 40 and agent.world_model.decoder is None
    assert hash_weights(ActorStep(agent)) == hash_weights(ActorStep(learner.agent))
    with pytest.raises(ValueError, match="do not fit"):
        load_agent(tmp_path, Interface(action_dim=3))
    with pytest.raises(ValueError, match="do not fit"):
        load_agent(tmp_path, Interface(pixels=False, vector_dim=21))
    incomplete = {"size": learner.state_dict()["size"], "agent": {}}
    part = SimpleNamespace(state_dict=lambda: incomplete, load_state_dict=None)
    RunCheckpoints(tmp_path / "incomplete", {"learner": part}).save(env_steps=40)
    with pytest.raises(ValueError, match="do not fit .* are missing"):
        load_agent(tmp_path / "incomplete", Interface())
    with pytest.raises(FileNotFoundError, match="No complete checkpoint"):
        load_agent(tmp_path / "nothing", Interface())
    with pytest.raises(ValueError, match="weights=averaged: .* holds the trained weights only"):
        load_agent(tmp_path, Interface(), "averaged")


# --- out of a folder that ships ---------------------------------------------------------------------------------------


def test_a_shipped_agent_flies_as_it_was_trained(shipped: Path, env: DroneRacingEnv) -> None:
    original, restored = make_agent(interface=SMALL), ShippedAgent.load(shipped, env)
    assert {path.name for path in shipped.iterdir()} == set(FILES) and is_agent(shipped)
    assert hash_weights(ActorStep(restored.agent)) == hash_weights(ActorStep(original))
    policy, onnx = restored.evaluation_policy(), OnnxActor(shipped / "actor.onnx")
    policy.deterministic = True
    flown = env.reset().update({"is_init": torch.ones(1, 1, dtype=torch.bool), "belief": torch.zeros(1, 32),
                                "state": torch.zeros(1, 16), "previous_action": torch.zeros(1, 4)})  # fmt: skip
    expected = ActorStep(original)(flown["pixels"], *(flown[key] for key in ("belief", "state", "previous_action")),
                                   flown["is_init"][0])[0]  # fmt: skip
    torch.testing.assert_close(policy(flown)["action"], expected, rtol=0, atol=0)
    np.testing.assert_allclose(onnx.step(flown["pixels"][0].numpy()), expected[0], atol=1e-5)


def test_only_what_flies_is_in_it(shipped: Path, env: DroneRacingEnv) -> None:
    restored = ShippedAgent.load(shipped, env)
    assert {name.partition(".")[0] for name in read_weights(shipped / "weights.safetensors")} == {
        "encoder", "rssm", "actor",
    }  # fmt: skip
    assert restored.value_function() is None
    assert restored.agent.critic is None and restored.agent.world_model.reward_head is None
    assert {name for name, _ in restored.agent.named_children()} == {"world_model", "actor"}
    held = sum(parameter.numel() for parameter in restored.agent.parameters())
    assert held == json.loads((shipped / "contract.json").read_text())["model"]["parameters"]


@pytest.mark.parametrize(
    ("other", "message"),
    [
        ({"camera": Camera(64, 64, tilt=30.0)}, "env.image_size=64: .*env.image_size=32"),
        ({"camera": Camera(32, 32, tilt=25.0)}, "env.camera_tilt=25.0: .*env.camera_tilt=30.0"),
        ({"camera": Camera(32, 32, 80.0, 30.0)}, "camera.vertical_field_of_view_deg=80.0: .*=90.0"),
        ({"camera_rate": 12.5}, "env.camera_rate=12.5: .*env.camera_rate=None"),
        ({"control_rate": 50.0}, "env.control_rate=50.0: .*round was trained with env.control_rate=25.0"),
        ({"imu": "noisy"}, "env.imu=exact: .*env.imu=none"),
        ({"from_pixels": False}, "env.from_pixels=False: .*env.from_pixels=True"),
    ],
    ids=["image size", "tilt", "view", "camera rate", "control rate", "imu", "numbers"],
)
def test_another_environment_is_refused(other: dict, message: str, shipped: Path) -> None:
    env = DroneRacingEnv(**WORLDS | other)
    with pytest.raises(ValueError, match=message):
        ShippedAgent.load(shipped, env)
    env.close()


def described(contract: dict, **camera: object) -> SimpleNamespace:
    """What `check_env` looks at of an environment that is as a contract describes it, but for its camera."""
    parameters = SimpleNamespace(control_dt=1.0 / contract["control"]["rate_hz"])
    seen = {"camera": replace(WORLDS["camera"], **camera), "imu": None, "custom_vector": None}
    return SimpleNamespace(from_pixels=True, worlds=SimpleNamespace(parameters=parameters, **seen))


@pytest.mark.parametrize(
    ("entry", "trained", "same", "other", "message"),
    [
        ("tilt_up_deg", 0.0, {"tilt": 1e-12}, {"tilt": 0.01}, "env.camera_tilt=0.01: .*env.camera_tilt=0.0"),
        ("tilt_up_deg", -10.0, {"tilt": -10.0 + 1e-12}, {"tilt": -9.99}, "env.camera_tilt=-9.99: "),
        ("rate_hz", 12.5, {"rate": 12.5}, {}, "env.camera_rate=None: .*env.camera_rate=12.5"),
        ("width_px", 48, {"width": 48}, {}, "env.image_size=32: .*env.image_size=48"),
        # no environment of this height is the same: it has another focal length, too
        ("height_px", 48, None, {}, "env.image_size=32: .*env.image_size=48"),
    ],
)
def test_an_agent_flies_with_its_own_camera_only(
    entry: str, trained: float, same: dict | None, other: dict, message: str, shipped: Path
) -> None:
    contract = read_contract(shipped / CONTRACT)
    contract["camera"][entry] = trained
    if same is not None:
        check_env(shipped, contract, described(contract, **same))
    with pytest.raises(ValueError, match=message):
        check_env(shipped, contract, described(contract, **other))


def test_a_slow_camera_is_in_the_contract_of_a_version_of_its_own(shipped: Path, env: DroneRacingEnv) -> None:
    contract = make_contract(
        ActorStep(make_agent(interface=SMALL)), env.worlds.parameters, replace(env.worlds.camera, rate=12.5)
    )
    assert (contract["format_version"], contract["camera"]["rate_hz"]) == (2, 12.5)
    assert read_contract(shipped / CONTRACT)["format_version"] == 1


def alter_weight(folder: Path, left_out: bool = False) -> None:
    weights = read_weights(folder / "weights.safetensors")
    bias = weights.pop("actor.mlp.output.bias") + 1e-3
    write_weights(folder / "weights.safetensors", weights if left_out else weights | {"actor.mlp.output.bias": bias})


def name_parts(folder: Path) -> None:
    contract = json.loads((folder / "contract.json").read_text())
    contract["files"] |= {part: {"name": f"actor_{part}.onnx", "sha256": ""} for part in ("advance", "act")}
    (folder / "contract.json").write_text(json.dumps(contract))


@pytest.mark.parametrize(
    ("spoil", "error", "message"),
    [
        (alter_weight, ValueError, "weights.safetensors holds other weights than .*contract.json"),
        (partial(alter_weight, left_out=True), ValueError, "weights.safetensors does not fit (?s:.*)mlp.output.bias"),
        (lambda folder: (folder / "contract.json").unlink(), FileNotFoundError, "lacks contract.json"),
        (name_parts, FileNotFoundError, "lacks actor_advance.onnx, actor_act.onnx"),
        (lambda folder: (folder / "agent.json").write_text("{"), ValueError, "agent.json is not valid JSON"),
    ],
    ids=["altered", "left out", "file", "parts", "json"],
)
def test_a_broken_folder_is_refused(spoil, error, message: str, shipped: Path, env, tmp_path: Path) -> None:
    shutil.copytree(shipped, tmp_path / "copy")
    spoil(tmp_path / "copy")
    with pytest.raises(error, match=message):
        ShippedAgent.load(tmp_path / "copy", env)


def test_the_flight_side_refuses_other_weights(shipped: Path, tmp_path: Path) -> None:
    shutil.copytree(shipped, tmp_path / "copy")
    alter_weight(tmp_path / "copy")
    with pytest.raises(ValueError, match="does not describe .*weights.safetensors: the SHA-256"):
        OnnxActor(tmp_path / "copy" / "actor.onnx")
    (tmp_path / "copy" / "weights.safetensors").unlink()
    with pytest.raises(FileNotFoundError, match="no .*weights.safetensors: it belongs beside actor.onnx"):
        OnnxActor(tmp_path / "copy" / "actor.onnx")
