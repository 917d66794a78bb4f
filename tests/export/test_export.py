"""Export: the copies fly as the policy does, a copy that does not is refused, and the flight side needs no torch."""

from __future__ import annotations

import copy
import functools
import itertools
import json
import math
import shutil
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from torch import Tensor

from dreamer_racing.envs.drone.parameters import PRESETS
from dreamer_racing.envs.simulator.scene import Camera
from dreamer_racing.export import actor_step as export
from dreamer_racing.export import onnx_actor
from dreamer_racing.export.actor_step import ActorStep, SampledActorStep, check_output, export_actor, make_step
from dreamer_racing.export.contract import hash_weights, make_contract
from dreamer_racing.export.parity import MIN_STEPS, ParityError, RecordedFlight, TorchActor, check_parity
from dreamer_racing.export.shipped_agent import load_agent
from dreamer_racing.modules import Interface, ModelSize
from dreamer_racing.modules.agent import Agent
from dreamer_racing.modules.layers import use_few_kernels
from dreamer_racing.modules.rssm import mix_uniform
from tests.export.recorded import make_agent, make_flight
from tests.running_recipes import ROOT, UNDRAWN, completed, python, recipe

pytest.importorskip("onnxscript")
pytest.importorskip("onnxruntime")
pytestmark = pytest.mark.xdist_group("export")  # one worker makes what these tests share

REFERENCE = ModelSize("tiny", belief=16, hidden=8, classes=4, units=8, cnn_depth=2, latents=4, blocks=4)
"""The 2025 architecture: block GRU, RMS norm, max-pool."""
LEARNED = ModelSize("tiny_learned", belief=16, hidden=8, classes=4, units=8, cnn_depth=2, latents=4,
                    recurrence="dense", norm="layer", learned_initial=True, strided=True)  # fmt: skip
"""The 2023 architecture: dense GRU, layer norm, a learned initial state."""


def contract_of(step: ActorStep) -> dict:
    return make_contract(step, PRESETS["easy"], Camera(), checkpoint="checkpoint-1", track="circle", preset="easy")


@pytest.fixture(scope="module")
def agent() -> Agent:
    return make_agent()


class Exported(NamedTuple):
    """An export, the flight that it was compared on, and the largest deviation of each copy."""

    path: Path
    flight: RecordedFlight
    deviation: dict[str, float]


NUMBERS = Interface(pixels=False, vector_dim=21)
KINDS: dict[str, tuple[dict, str, dict]] = {
    "mode": ({}, "mode", {}),
    "sample": ({}, "sample", {}),
    "numbers": ({"interface": NUMBERS}, "mode", {}),
    "block": ({"size": REFERENCE}, "sample", {}),
    "block in parts": ({"size": REFERENCE}, "mode", {"parts": True, "shared_weights": True}),
    "learned": ({"size": LEARNED}, "mode", {}),
    "learned in parts": ({"size": LEARNED}, "sample", {"parts": True}),
}
"""Exports: of which agent, in which latent mode, with which options."""


@pytest.fixture(scope="module")
def exports(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Exported]:
    """Exports one of `KINDS`, once."""

    @functools.cache
    def export_once(kind: str) -> Exported:
        of_agent, latent, options = KINDS[kind]
        output, agent = tmp_path_factory.mktemp("export") / "actor.onnx", make_agent(**of_agent)
        step, flight = make_step(agent, latent), make_flight(agent)
        return Exported(output, flight, export_actor(step, contract_of(step), flight, output, **options))

    return export_once


@pytest.fixture(scope="module", params=["mode", "sample"])
def exported(request: pytest.FixtureRequest, exports: Callable[[str], Exported]) -> Path:
    """The .onnx file of an export of either latent mode."""
    return exports(request.param).path


# --- the step ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", ["debug", LEARNED], ids=["zero", "learned"])
def test_a_reset_forgets_everything(size: ModelSize | str) -> None:
    step = ActorStep(make_agent(size))
    inputs = step.example_inputs()
    garbage = {name: torch.full_like(inputs[name], math.nan) for name in ("h", "z", "previous_action")}
    for clean, dirty in zip(step(*inputs.values()), step(*(inputs | garbage).values()), strict=True):
        torch.testing.assert_close(clean, dirty, rtol=0, atol=0)
    kept = step(*(inputs | {"h": torch.ones_like(inputs["h"]), "is_init": torch.tensor([False])}).values())
    assert not torch.equal(kept[1], step(*inputs.values())[1])


def test_a_sample_is_the_gumbel_maximum_of_the_posterior(agent: Agent) -> None:
    step, count = SampledActorStep(agent), 4000
    inputs = {name: value.expand(count, *value.shape[1:]) for name, value in step.example_inputs().items()}
    noise = torch.rand(count, *step.noise_shape, generator=torch.Generator().manual_seed(0))
    z = step(*(inputs | {"noise": noise}).values())[2].unflatten(-1, step.noise_shape)
    pixels, is_init = torch.zeros(1, 1, 64, 64, 3, dtype=torch.uint8), torch.ones(1, 1, dtype=torch.bool)
    posterior = agent.world_model.observe({"pixels": pixels}, torch.zeros(1, 1, 4), is_init)
    probabilities = mix_uniform(posterior.posterior_logits[0, 0], agent.world_model.rssm.unimix).double()
    expected = (probabilities.log() - (-noise.double().log()).log()).argmax(-1)
    assert torch.equal(z.argmax(-1), expected) and torch.equal(z.sum(-1), torch.ones(count, 4))
    # The training policy samples this distribution by another method: five standard deviations.
    deviation = (probabilities * (1 - probabilities) / count).sqrt()
    assert ((z.double().mean(0) - probabilities).abs() < 5 * deviation).all()


def test_noise_of_zero_is_no_accident(agent: Agent) -> None:
    step = SampledActorStep(agent)
    noise = torch.zeros(1, *step.noise_shape)
    noise[..., 2] = 0.5
    z = step(*(step.example_inputs() | {"noise": noise}).values())[2].unflatten(-1, step.noise_shape)
    assert z.isfinite().all() and torch.equal(z.argmax(-1), torch.full((1, 4), 2))


# --- the copies -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_every_architecture_flies_alike(kind: str, exports: Callable[[str], Exported]) -> None:
    options, (output, _, deviation) = KINDS[kind][-1], exports(kind)
    copies, files = {"onnxruntime", "torch.export"}, {"actor.onnx", "contract.json"}
    files |= {"weights.safetensors" if "shared_weights" in options else "actor.pt2"}
    if "parts" in options:
        copies, files = copies | {"onnxruntime in parts"}, files | {"actor_advance.onnx", "actor_act.onnx"}
    assert deviation.keys() == copies and max(deviation.values()) < 1e-5
    assert {path.name for path in output.parent.iterdir()} == files


def test_what_flies_otherwise_than_the_policy_did_is_refused(agent: Agent, tmp_path: Path) -> None:
    flight, step = copy.deepcopy(make_flight(agent)), ActorStep(agent)
    flight.actions[150, 0] += 1e-3
    with pytest.raises(ParityError, match=r"^torch does not match the policy: at step 150 of 200 .* 1 steps are"):
        export_actor(step, contract_of(step), flight, tmp_path / "actor.onnx")
    assert not list(tmp_path.iterdir())


def copies(onnx: Path, program: Path) -> Callable[[ActorStep, Path, Path], None]:
    """In place of `write_step`: copies files that it has written."""

    def write(step: ActorStep, onnx_output: Path, program_output: Path) -> None:
        shutil.copy(onnx, onnx_output)
        shutil.copy(program, program_output)

    return write


def test_an_export_of_another_kind_leaves_nothing_of_an_earlier_one(agent, exports, tmp_path, monkeypatch) -> None:
    step, (whole, flight, _) = make_step(agent, "mode"), exports("mode")
    shutil.copytree(exports("block in parts").path.parent, tmp_path / "old")
    monkeypatch.setattr(export, "write_step", copies(whole, whole.with_suffix(".pt2")))
    (tmp_path / "old" / "actor_act.onnx").unlink()  # gone already
    (tmp_path / "new").mkdir()
    (tmp_path / "new" / "weights.safetensors").write_text("mine")  # where no export has been
    files = {"actor.onnx", "actor.pt2", "contract.json"}
    for folder, expected in (("old", files), ("new", files | {"weights.safetensors"})):
        export_actor(step, contract_of(step), flight, tmp_path / folder / "actor.onnx")
        assert {path.name for path in (tmp_path / folder).iterdir()} == expected
    assert (tmp_path / "new" / "weights.safetensors").read_text() == "mine"


@pytest.mark.parametrize("kind", ["learned in parts", "block in parts"])
def test_a_step_in_two_parts_is_the_whole_one(kind: str, exports: Callable[[str], Exported]) -> None:
    """Whether its first part is run ahead of time, and whether that is in vain because the flight begins anew."""
    output, flight, _ = exports(kind)
    ahead, late, whole = (onnx_actor.OnnxActor(output, seed=3, whole=each) for each in (False, False, True))
    assert (ahead.in_parts, whole.in_parts) == (True, False)
    for image, is_init in zip(flight.observations, flight.is_init, strict=True):
        if is_init:
            for actor in (ahead, late, whole):
                actor.reset()
        action = ahead.step(image)
        np.testing.assert_array_equal(action, late.step(image))
        np.testing.assert_allclose(action, whole.step(image), atol=1e-5)
        ahead.prepare()
        whole.prepare()  # nothing


def test_parts_of_another_export_are_refused(exports: Callable[[str], Exported], tmp_path: Path) -> None:
    shutil.copytree(exports("block in parts").path.parent, tmp_path, dirs_exist_ok=True)
    output = tmp_path / "actor.onnx"
    contract = json.loads((tmp_path / "contract.json").read_text())
    files = contract["files"]
    files["advance"], files["act"] = files["act"], files["advance"]
    (tmp_path / "contract.json").write_text(json.dumps(contract))
    with pytest.raises(ValueError, match="actor_act.onnx has the inputs and outputs .* but its contract promises"):
        onnx_actor.OnnxActor(output)
    (tmp_path / "actor_act.onnx").unlink()
    with pytest.raises(FileNotFoundError, match="actor_act.onnx: it belongs beside actor.onnx"):
        onnx_actor.OnnxActor(output)


def test_the_flight_side_flies_as_torch_does(exported: Path, agent: Agent) -> None:
    """As `check_parity` says it, without `check_parity`; and z changes, so that a flip could be seen."""
    import onnxruntime

    contract = json.loads((exported.parent / "contract.json").read_text())
    step, flight = make_step(agent, contract["latent"]), make_flight(agent)
    session = onnxruntime.InferenceSession(exported)
    inputs = {name: value.numpy() for name, value in step.example_inputs().items()}
    actor, random, classes = onnx_actor.OnnxActor(exported), np.random.default_rng(1), []
    for image, is_init in zip(flight.observations, flight.is_init, strict=True):
        noise = random.random((4, 4), np.float32) if step.noise_shape else None
        inputs |= {"image_u8": image[None], "is_init": np.array([is_init])}
        inputs |= {} if noise is None else {"noise": noise[None]}
        expected = [output.numpy() for output in step(*(torch.from_numpy(value) for value in inputs.values()))]
        for got, wanted in zip(session.run(None, inputs), expected, strict=True):
            np.testing.assert_allclose(got, wanted, atol=1e-5)
        if is_init:
            actor.reset()
        np.testing.assert_allclose(actor.step(image, noise), expected[0][0], atol=1e-5)
        np.testing.assert_array_equal(actor.state["z"], expected[2])
        inputs |= dict(zip(("previous_action", "h", "z"), expected, strict=True))
        classes.append(tuple(expected[2][0]))
    assert len(set(classes)) > 3


def test_reset_begins_again_and_a_seed_repeats(exported: Path) -> None:
    images = np.random.default_rng(0).integers(0, 256, (5, 64, 64, 3), np.uint8)
    actor = onnx_actor.OnnxActor(exported, seed=5)
    first = [actor.step(image) for image in images]
    actor.reset()
    second = [actor.step(image) for image in images]
    same_seed = onnx_actor.OnnxActor(exported, seed=5)
    np.testing.assert_array_equal(first, [same_seed.step(image) for image in images])
    assert np.array_equal(first, second) == (actor.noise_shape is None), "only noise may tell the episodes apart"


def test_the_files_hold_no_paths_of_this_machine(exported: Path) -> None:
    assert str(ROOT).encode() not in exported.read_bytes()
    with zipfile.ZipFile(exported.with_suffix(".pt2")) as archive:
        assert not any(str(ROOT).encode() in archive.read(name) for name in archive.namelist())


# --- refusal ----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def altered(agent: Agent, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Both files of a step with an altered weight."""
    folder, step = tmp_path_factory.mktemp("altered"), ActorStep(copy.deepcopy(agent))
    next(step.rssm.cell.parameters()).add_(0.5)
    export.write_step(step, folder / "actor.onnx", folder / "actor.pt2")
    return folder


@pytest.mark.parametrize(("kind", "name"), [("onnx", "onnxruntime"), ("program", "torch.export")])
def test_an_altered_weight_is_refused(kind: str, name: str, agent, altered, exports, tmp_path, monkeypatch) -> None:
    step, (earlier, flight, _), output = ActorStep(agent), exports("mode"), tmp_path / "actor.onnx"
    files = {"onnx": earlier, "program": earlier.with_suffix(".pt2")}
    shutil.copytree(earlier.parent, tmp_path, dirs_exist_ok=True)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    files[kind] = altered / files[kind].name
    monkeypatch.setattr(export, "write_step", copies(**files))
    with pytest.raises(ParityError, match=rf"^{name} does not match torch: at step \d+ of 200 .* deviates by \d"):
        export_actor(step, contract_of(step), flight, output)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before, "the earlier export stays"
    with pytest.raises(ParityError):
        export_actor(step, contract_of(step), flight, tmp_path / "new" / "actor.onnx")
    assert not list((tmp_path / "new").iterdir())


def check_disturbed(agent: Agent, change: Callable[[list[Tensor]], object], latent: str = "mode") -> float:
    """Change the outputs of the flight's last step in a copy, where no later step can show it."""
    step, calls = make_step(agent, latent), itertools.count(1)

    def disturbed(*inputs: Tensor) -> list[Tensor]:
        outputs = [output.clone() for output in step(*inputs)]
        if next(calls) == MIN_STEPS:
            change(outputs)
        return outputs

    actors = {name: TorchActor(contract_of(step), fly) for name, fly in (("torch", step), ("copy", disturbed))}
    return check_parity(actors, make_flight(agent))["copy"]


def add_to_action(value: float) -> Callable[[list[Tensor]], object]:
    return lambda outputs: outputs[0][0, 1].add_(value)


def test_an_export_computes_as_on_a_cpu_whatever_its_learner_was_told(agent: Agent) -> None:
    told = copy.deepcopy(agent)
    use_few_kernels(told)
    modules = list(ActorStep(told).modules())
    assert any(hasattr(part, "few_kernels") for part in modules)
    assert not any(getattr(part, "few_kernels", False) for part in modules)


def test_the_tolerance_of_actions(agent: Agent) -> None:
    assert check_disturbed(agent, add_to_action(0.8e-4)) == pytest.approx(0.8e-4, rel=0.02)
    for value in (1.2e-4, math.nan):
        with pytest.raises(ParityError, match=r"^copy .* step 199 of 200 .* 1 steps are affected"):
            check_disturbed(agent, add_to_action(value))


@pytest.mark.parametrize(("latent", "end"), [("mode", "written.$"), ("sample", "try another seed.$")])  # bad luck
def test_a_flipped_latent_is_refused_even_if_no_action_shows_it(latent: str, end: str, agent: Agent) -> None:
    def next_class(outputs: list[Tensor]) -> None:
        outputs[2] = outputs[2].view(4, 4).roll(1, dims=1).view(1, 16)

    deviates = rf"step 199 of 200.*by 0.00e\+00.*latent 0 by 1.00e\+00 \(allowed: 1e-03\).*{end}"
    with pytest.raises(ParityError, match=deviates):
        check_disturbed(agent, next_class, latent)


# --- the contract -----------------------------------------------------------------------------------------------------


def test_the_contract_says_what_a_pilot_must_know(exported: Path, agent: Agent) -> None:
    contract = json.loads((exported.parent / "contract.json").read_text())
    step = make_step(agent, contract["latent"])
    inputs = {entry["name"]: (entry["shape"], entry["type"]) for entry in contract["inputs"]}
    assert inputs == {
        "image_u8": ([1, 64, 64, 3], "uint8"), "h": ([1, 32], "float32"), "z": ([1, 16], "float32"),
        "previous_action": ([1, 4], "float32"), "is_init": ([1], "bool"),
        **({"noise": ([1, 4, 4], "float32")} if contract["latent"] == "sample" else {}),
    }  # fmt: skip
    assert [entry["name"] for entry in contract["outputs"]] == ["action", "h_next", "z_next"]
    assert contract["control"] == {"rate_hz": 50.0, "period_s": 0.02}
    camera = contract["camera"]
    assert (camera["width_px"], camera["height_px"], camera["vertical_field_of_view_deg"]) == (64, 64, 90.0)
    assert camera["focal_length_px"] == pytest.approx(32.0)
    assert camera["tilt_up_deg"] == 25.0 and camera["position_body_m"] == [0.10, 0.0, 0.02]
    assert contract["frames"]["body"].startswith("FLU") and "is_init" in contract["reset"]
    assert contract["weights_sha256"] == hash_weights(step) and contract["model"]["name"] == "debug"
    assert contract["files"]["onnx"]["sha256"] == onnx_actor.hash_file(exported)
    verification = contract["verification"]
    assert verification["steps"] == 200 and verification["episodes"] == 6 and verification["latent_flips"] == 0


def test_the_contract_of_an_agent_that_sees_numbers_lists_them() -> None:
    contract = contract_of(ActorStep(make_agent(interface=NUMBERS)))
    assert contract["camera"] is None
    channels = contract["vector"]["channels"]
    assert len(channels) == 21
    assert channels[4] == {"name": "body rates of the drone, y", "unit": "rad/s", "divisor": 5.0}


def test_actions_get_their_units(exported: Path) -> None:
    actor = onnx_actor.OnnxActor(exported)
    np.testing.assert_allclose(actor.setpoint(np.zeros(4)), [13.33, 0, 0, 0])
    np.testing.assert_allclose(actor.setpoint(np.array([1.0, -1.0, 1.0, 7.0])), [26.66, -10, 10, 4])
    hover = np.array(actor.contract["action"]["hover"])
    np.testing.assert_allclose(actor.setpoint(hover), [9.81, 0, 0, 0], atol=1e-3)


def test_the_hash_is_that_of_the_weights(agent: Agent) -> None:
    step = ActorStep(agent)
    other = copy.deepcopy(step)
    assert hash_weights(other) == hash_weights(step) == hash_weights(SampledActorStep(agent))
    next(other.actor.parameters())[0] += 1e-6
    assert hash_weights(other) != hash_weights(step)


# --- the flight side --------------------------------------------------------------------------------------------------

FORBIDDING = """
import importlib.abc, sys

class Forbid(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {forbidden!r}:
            raise ImportError(f"{{name}} is forbidden here")

sys.meta_path.insert(0, Forbid())
import numpy
from {module} import OnnxActor
actor = OnnxActor({path!r}, seed=0)
first, second = (actor.step(numpy.full((64, 64, 3), value, numpy.uint8)) for value in (10, 200))
assert first.shape == (4,) and 0 < abs(first).max() <= 1 and not (first == second).any()
print("flown")
"""


@pytest.mark.parametrize("alone", [True, False], ids=["plain file", "package"])
def test_the_flight_side_needs_no_torch(alone: bool, exported: Path, tmp_path: Path) -> None:
    forbidden, module = ["torch", "tensordict", "torchrl", "mujoco", "hydra"], "dreamer_racing.export.onnx_actor"
    if alone:
        shutil.copy(onnx_actor.__file__, tmp_path)
        forbidden, module = [*forbidden, "gymnasium", "dreamer_racing", "onnx", "onnxscript"], "onnx_actor"
    done = python("-c", FORBIDDING.format(forbidden=forbidden, module=module, path=str(exported)), cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "flown\n"


def test_the_flight_side_measures_itself(exported: Path) -> None:
    done = python(onnx_actor.__file__, str(exported), "--steps", "30")
    assert done.returncode == 0, done.stderr
    assert python(onnx_actor.__file__, str(exported), "--steps", "0").stderr.endswith("must be at least 1.\n")
    assert "30 steps, 1 thread(s): p50" in done.stdout and "p99" in done.stdout and "max" in done.stdout


def test_the_percentiles_of_a_latency() -> None:
    assert str(onnx_actor.Latency(0.1, 1.25, 3.0)) == "p50 0.10 ms, p99 1.25 ms, max 3.00 ms"
    seen: list[float] = []
    latency = onnx_actor.measure_latency(lambda row: seen.append(row[0]), np.zeros((7, 1)))
    assert len(seen) == 7 + onnx_actor.WARM_UP_STEPS and 0 < latency.p50 <= latency.p99 <= latency.max


@pytest.mark.parametrize(
    ("observation", "words"),
    [
        (np.zeros((32, 64, 3), np.uint8), ["image_u8", "(32, 64, 3)", "(64, 64, 3)"]),
        (np.zeros((1, 64, 64, 3), np.uint8), ["(1, 64, 64, 3)"]),
        (np.zeros((64, 64, 3), np.float32), ["float32", "uint8"]),
        ([[0]], ["list", "numpy"]),
    ],
    ids=["size", "batch", "type", "list"],
)
def test_a_wrong_image_is_refused_and_changes_nothing(exported: Path, observation: object, words: list[str]) -> None:
    actor = onnx_actor.OnnxActor(exported)
    actor.step(np.zeros((64, 64, 3), np.uint8))
    before = actor.state["h"].copy()
    with pytest.raises(ValueError, match="image_u8") as error:
        actor.step(observation)
    assert all(word in str(error.value) for word in words)
    np.testing.assert_array_equal(actor.state["h"], before)


def test_noise_and_numbers_are_checked_too(exported: Path) -> None:
    with pytest.raises(ValueError, match="noise"):
        onnx_actor.OnnxActor(exported).step(np.zeros((64, 64, 3), np.uint8), np.zeros((3, 3), np.float32))
    step = ActorStep(make_agent(interface=NUMBERS))
    with pytest.raises(ValueError, match="vector: .* not finite"):
        TorchActor(contract_of(step), step).step(np.full(21, np.nan, np.float32))


def spoil(key: str, value: object, of_first_input: bool = False) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        contract = json.loads(path.read_text())
        (contract["inputs"][0] if of_first_input else contract)[key] = value
        path.write_text(json.dumps(contract))

    return write


CHANNEL = {"name": "x", "unit": "m", "offset": 0}


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        (Path.unlink, FileNotFoundError, "contract.json"),
        (lambda path: path.write_text("{"), ValueError, "not valid JSON"),
        (lambda path: path.write_text("[]"), ValueError, "format None"),
        (spoil("format_version", 3), ValueError, "version 3.* versions 1 and 2"),
        (spoil("files", {"onnx": {"name": "actor.onnx", "sha256": "0"}}), ValueError, "SHA-256"),
        (spoil("outputs", [{"name": "thrust", "shape": [1, 4], "type": "f"}]), ValueError, "promises .*thrust"),
        (spoil("files", {"onnx": 3}), ValueError, "files.onnx is 3, not an object"),
        (spoil("action", {"channels": [CHANNEL]}), ValueError, "channels.0. lacks scale"),
        (spoil("control", {"rate_hz": float("nan")}), ValueError, "rate_hz is nan, not a number"),
        (spoil("control", {"rate_hz": -25}), ValueError, "rate_hz is -25, not above 0"),
        (spoil("control", None), ValueError, "control is None, not an object"),
        (spoil("source", {"track": 3}), ValueError, "source.track is 3, not a string"),
        (spoil("rate_loop", {"kind": "betaflight", "p": [45.0]}), ValueError, "rate_loop lacks d, motor_time_const"),
        (spoil("inputs", [{"name": "h", "shape": [1], "type": "float32"}]), ValueError, "inputs lacks z, previous"),
        (spoil("shape", [2**40], of_first_input=True), ValueError, "has the shape .1099511627776"),
        (spoil("type", "object", of_first_input=True), ValueError, "is of type 'object', not uint8"),
        (spoil("action", {"channels": [CHANNEL | {"scale": 1}]}), ValueError, "1 entries, but"),
        (spoil("camera", 0), ValueError, "camera is 0, not an object"),
        (spoil("weights_sha256", None), ValueError, "weights_sha256 is None, not a string"),
        (lambda path: path.write_text("[" * 100_000), ValueError, "not valid JSON"),
    ],
)
def test_a_contract_of_another_file_is_refused(exported: Path, tmp_path: Path, change, error, words: str) -> None:
    for name in ("actor.onnx", "contract.json"):
        shutil.copy(exported.with_name(name), tmp_path)
    change(tmp_path / "contract.json")
    with pytest.raises(error, match=words):
        onnx_actor.OnnxActor(tmp_path / "actor.onnx")


def test_a_missing_actor_or_runtime_is_named(exported: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(FileNotFoundError, match="nothing.onnx"):
        onnx_actor.OnnxActor(exported.with_name("nothing.onnx"))
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(ImportError, match="pip install onnxruntime"):
        onnx_actor.OnnxActor(exported)


# --- bad input --------------------------------------------------------------------------------------------------------


def test_bad_arguments_are_refused(agent: Agent, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValueError, match="latent=median: must be one of mode, sample"):
        make_step(agent, "median")
    with pytest.raises(ValueError, match="observes pixels and vector; besides images, only an IMU"):
        make_step(make_agent(interface=Interface(vector_dim=21)), "mode")
    with pytest.raises(ValueError, match="a custom vector of 5 numbers; only the race's 21 numbers"):
        make_step(make_agent(interface=Interface(pixels=False, vector_dim=5)), "mode")
    with pytest.raises(ValueError, match="must end in .onnx"):
        check_output(tmp_path / "actor.pt")
    with pytest.raises(PermissionError, match="output=/dev/null/x/actor.onnx: cannot write"):
        check_output("/dev/null/x/actor.onnx")
    (tmp_path / "contract.json").write_text("{}")
    with pytest.raises(ValueError, match="describes another actor"):
        check_output(tmp_path / "actor.onnx")
    (tmp_path / "contract.json").write_text('{"files": {"onnx": {"name": "actor.onnx"}}}')
    (tmp_path / "actor_act.onnx").touch()  # a part of that actor
    with pytest.raises(ValueError, match="describes another actor"):
        check_output(tmp_path / "actor_act.onnx")
    assert check_output(tmp_path / "actor.onnx") == tmp_path / "actor.onnx"
    step = ActorStep(agent)
    with pytest.raises(ValueError, match="steps=199: .* at least 200"):
        export_actor(step, contract_of(step), make_flight(agent, 199), tmp_path / "new" / "actor.onnx")
    monkeypatch.setattr(export, "PROTOBUF_LIMIT", 1000)
    with pytest.raises(ValueError, match="less than 2 GB"):
        export_actor(step, contract_of(step), make_flight(agent), tmp_path / "new" / "actor.onnx")
    assert not list((tmp_path / "new").iterdir())
    monkeypatch.setattr(export, "PACKAGES", ("onnx", "no_such_package"))
    with pytest.raises(export.MissingPackagesError, match=r"needs no_such_package.*\[export\]"):
        check_output(tmp_path / "actor.onnx")


# --- the recipe -------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished debug run on small images, of a loss that has no image decoder."""
    directory = tmp_path_factory.mktemp("runs") / "first run"
    completed(
        "dreamer_v3", "track=circle", "model=debug", "loss=privileged", "env.preset=faithful", "env.camera_tilt=30",
        "env.image_size=32", "env.control_rate=40", "model.state_std=false",
        "env.num_envs=4", "prefill=100", "total_env_steps=160", "replay.capacity=1000", "evaluation.every=0",
        f"run_dir='{directory}'", cwd=directory.parent, before=UNDRAWN,
    )  # fmt: skip
    return directory


def test_the_recipe_exports_a_run(run_dir: Path) -> None:
    done = completed("export", f"checkpoint='{run_dir}'", cwd=run_dir.parent)
    assert "Warning" not in done.stderr
    folder = run_dir / "export"
    assert {path.name for path in folder.iterdir()} == {"actor.onnx", "actor.pt2", "contract.json"}
    shown = ("replayed: 200 steps", "onnxruntime from torch", "1 thread, onnxruntime: p50", "1 thread, torch: p50")
    assert all(words in done.stdout for words in shown), done.stdout
    contract = json.loads((folder / "contract.json").read_text())
    assert contract["control"] == {"rate_hz": 40.0, "period_s": 0.025}
    assert contract["camera"]["tilt_up_deg"] == 30.0 and contract["action"]["trained_command_delay_s"] == [0.0, 0.04]
    assert contract["source"]["env_steps"] == 160 and contract["verification"]["episodes"] >= 4
    assert (contract["camera"]["width_px"], contract["camera"]["height_px"]) == (32, 32)
    assert contract["camera"]["focal_length_px"] == pytest.approx(16.0)  # 90° of view: half the height
    agent, _ = load_agent(run_dir, Interface(image_size=32))
    assert contract["weights_sha256"] == hash_weights(ActorStep(agent))
    assert onnx_actor.OnnxActor(folder / "actor.onnx").step(np.zeros((32, 32, 3), np.uint8)).shape == (4,)
    assert OmegaConf.load(run_dir / "config.yaml").env.camera_tilt == 30.0


def test_the_recipe_refuses_a_copy_that_flies_differently(run_dir: Path) -> None:
    altered = (
        "import dreamer_racing.export.actor_step as export, copy\n"
        "write = export.write_step\n"
        "def altered(step, onnx, program):\n"
        "    step = copy.deepcopy(step)\n"
        "    next(step.rssm.cell.parameters()).add_(5.0)\n"
        "    write(step, onnx, program)\n"
        "export.write_step = altered\n"
    )
    output = run_dir.parent / "refused" / "actor.onnx"
    done = recipe(
        "export", f"checkpoint='{run_dir}'", f"output='{output}'", "latent=sample", cwd=run_dir.parent, before=altered
    )
    assert done.returncode == 1, done.stderr
    assert "error: onnxruntime does not match torch: at step" in done.stderr and "Traceback" not in done.stderr
    assert "try another seed" in done.stderr, "a sample can be bad luck"
    assert not list(output.parent.iterdir())
