"""Export a trained actor for flight: ONNX, a torch.export program, and the contract of both.

    python recipes/export.py checkpoint=runs/dreamer_v3_kidney_20260101-120000 output=exports/kidney/actor.onnx
    python recipes/export.py checkpoint=runs/dreamer_v3_kidney_20260101-120000 agent=agents/kidney

Records a flight on the track that the policy was trained on, replays it through every exported copy, and writes them
only if their actions agree; then measures how long a step takes. dreamer_racing/export/onnx_actor.py runs them.

With agent= the folder gets everything that other recipes need to fly the agent too, see docs/agents.md: an evaluation
of exactly these weights must have been made before.
"""

import json
import logging
import shlex
import sys
import warnings
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from composing.building import shared_env_arguments
from composing.entry import as_override, override_key, override_value, plain_errors, recipe
from composing.options import command
from composing.saved import trained_config
from composing.schema import WorldModelRunConfig, is_race
from omegaconf import MISSING, OmegaConf
from torch import set_num_threads

from dreamer_racing.envs.drone.parameters import name_of_preset
from dreamer_racing.envs.imu import load_imu
from dreamer_racing.envs.torchrl_env import DroneRacingEnv
from dreamer_racing.envs.tracks import BUILTIN_TRACKS, Track, describe_track, hash_track, load_track
from dreamer_racing.export.actor_step import (
    LATENTS,
    ActorStep,
    MissingPackagesError,
    check_output,
    export_actor,
    make_step,
)
from dreamer_racing.export.contract import make_contract
from dreamer_racing.export.onnx_actor import CONTRACT, read_contract
from dreamer_racing.export.parity import ParityError, RecordedFlight, episode_steps, measure_latencies, record_flight
from dreamer_racing.export.shipped_agent import (
    ACTOR,
    AGENT,
    CONFIG,
    ShippedAgent,
    choose_weights,
    config_folder,
    find_trained,
    is_agent,
    load_agent,
    newest_evaluation,
    read_evaluation,
    results_of,
)
from dreamer_racing.modules import Interface
from dreamer_racing.settings import COUNT, SEED, check_choice, setting
from dreamer_racing.training.directory import RunDirectory

MACHINE_SETTINGS = ("run_dir", "resume", "device", "env.device")  # settings that do not affect what is learned


@dataclass
class ExportConfig:
    """Configuration of `recipes/export.py`."""

    checkpoint: str = MISSING  # run directory, checkpoint, or agent (docs/agents.md)
    weights: str = "auto"  # auto | averaged | trained: which to export; auto takes the averaged ones if there are any
    output: str | None = None  # .onnx file, in a folder of its own; null: <run of the checkpoint>/export/actor.onnx
    agent: str | None = None  # folder for a complete agent, instead of output, e.g. agents/kidney
    evaluation: str | None = None  # with agent=: evaluation.json to include; null: the run's latest of these weights
    commit: str | None = None  # with agent=: git commit of the training; null: the one that the run noted
    latent: str = "mode"  # mode: nothing is sampled | sample: takes noise
    # also write the step in two parts, so that the one without images can run before the image (docs/export.md)
    parts: bool = False
    steps: int = setting(200, COUNT)  # control steps of a recorded flight, on which the export must act as the original
    renderer: str = "auto"
    seed: int = setting(0, SEED)


@recipe("export", ExportConfig)
def main(config: ExportConfig) -> None:
    """Restore the policy, fly it, export it, compare, measure."""
    # torch's exporter reports four times that torchvision is not installed, which is not needed, and warns of copying a
    # class of its own.
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    warnings.filterwarnings("ignore", r"`isinstance\(treespec, LeafSpec\)` is deprecated", FutureWarning, r"copyreg$")
    set_num_threads(1)
    try:
        with plain_errors():
            export(config)
    except (ParityError, MissingPackagesError) as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(1) from error


def export(config: ExportConfig) -> None:
    """Export the actor and print the results."""
    check_choice("latent", config.latent, LATENTS)
    checkpoint = find_trained(config.checkpoint)
    trained = trained_config(config_folder(checkpoint))
    if not isinstance(trained, WorldModelRunConfig):
        raise ValueError(f"{checkpoint} was trained by {trained.algorithm}; exported are dreamer_v3 and latent_ppo.")
    if not is_race(trained):
        raise ValueError(f"{checkpoint} was trained on {trained.task}; this recipe exports actors that race.")
    if trained.env.vector is not None:
        raise ValueError(
            f"{checkpoint} was trained with env.vector={trained.env.vector}, which reads the simulator's state, "
            "unknown to a real drone: export an agent that sees images, or images and env.imu."
        )
    check_agent(config, checkpoint)
    output = check_output(config.output or Path(config.agent or results_of(checkpoint) / "export") / ACTOR)
    if not config.agent and is_agent(output.parent):
        raise ValueError(f"output={config.output}: {output.parent} holds an agent, which is kept: choose another.")
    print(f"checkpoint: {checkpoint}")
    step, contract, flight = prepare(config, trained, checkpoint)
    about = describe(config, trained, checkpoint, contract) if config.agent else None
    deviation = export_actor(step, contract, flight, output, config.seed, about is not None, config.parts)
    print(f"replayed: {len(flight.actions)} steps, {flight.episodes} episodes, latents equal")
    for name, value in deviation.items():
        print(f"largest deviation of an action, {name} from torch: {value:.1e}")
    names = [*(file["name"] for file in read_contract(output.parent / CONTRACT)["files"].values()), CONTRACT]
    if about:
        write_agent(output.parent, trained, about)
        drone = RunDirectory(output.parent).drone
        names += [CONFIG, AGENT, *([drone.name] if drone.exists() else [])]
    for line in measure_latencies(step, flight, output, config.parts):
        print(line)
    size = sum((output.parent / name).stat().st_size for name in names)
    print(f"written to {output.parent}: {', '.join(names)} ({size / 1e6:.2f} MB)")


def prepare(
    config: ExportConfig, trained: WorldModelRunConfig, checkpoint: Path
) -> tuple[ActorStep, dict[str, Any], RecordedFlight]:
    """Restore the policy and fly it; return the step to export, its contract and the flight."""
    env = DroneRacingEnv(
        num_envs=1,
        seed=config.seed,
        episode_steps=episode_steps(config.steps),
        num_threads=1,
        **shared_env_arguments(trained) | {"renderer": config.renderer, "device": "cpu", "reward": None},
    )
    try:
        if is_agent(checkpoint):
            shipped = ShippedAgent.load(checkpoint, env)
            agent, metadata = shipped.agent, shipped.about
            choose_weights(config.weights, metadata["weights"], checkpoint)
        else:
            agent, metadata = load_agent(checkpoint, Interface.of(env), config.weights)
        print(f"weights: {metadata['weights']}{' (weights=auto)' if config.weights == 'auto' else ''}")
        step = make_step(agent, config.latent)
        flight = record_flight(env, agent, config.steps)
    finally:
        env.close()
    track = trained.saved_track()
    contract = make_contract(
        step,
        env.worlds.parameters,
        env.worlds.camera,
        load_imu(shared_env_arguments(trained)["imu"]),
        checkpoint=checkpoint.name,
        env_steps=metadata["env_steps"],
        weights=metadata["weights"],
        track=name_of(track, trained.track),
        track_sha256=hash_track(track),
        preset=Path(trained.env.preset).name,
        **({} if trained.track_description is None else {"track_description": describe_track(track)}),
    )
    return step, contract, flight


def name_of(track: Track, given: str) -> str:
    """Return the name of the built-in track that is the same, with its decoys, or else the track's file name."""
    same = track.name in BUILTIN_TRACKS and hash_track(load_track(track.name)) == hash_track(track)
    return track.name if same else Path(given).name


def check_agent(config: ExportConfig, checkpoint: Path) -> None:
    """Refuse settings that need agent= or conflict with it."""
    if not config.agent:
        if given := [name for name in ("evaluation", "commit") if getattr(config, name) is not None]:
            raise ValueError(f"{given[0]}={getattr(config, given[0])} is for agent=FOLDER: leave it out.")
        return
    if config.output:
        raise ValueError(f"output={config.output} and agent={config.agent}: give one of them.")
    if config.latent != "mode":
        raise ValueError(f"latent={config.latent}: agents ship with latent=mode, with which they are evaluated.")
    if is_agent(checkpoint):
        raise ValueError(f"checkpoint={config.checkpoint} is an agent already: copy its folder.")


def describe(
    config: ExportConfig, trained: WorldModelRunConfig, checkpoint: Path, contract: dict[str, Any]
) -> dict[str, Any]:
    """Return the contents of agent.json: where the agent comes from, and how well it flies."""
    source = contract["source"]
    history = history_of(checkpoint, source["env_steps"])
    commit = config.commit or (history[-1]["commit"] if history else None)
    if commit is None:
        print("commit of the training: unknown, because neither the run nor commit= gives it")
    trains = f"python recipes/{trained.algorithm}.py {shlex.join(history[-1]['overrides'])}" if history else None
    training = {"command": trains, "commit": commit, "seed": trained.seed}
    if len(history) > 1:  # resumed, perhaps with other settings
        training["starts"] = history
    weights, track = contract["weights_sha256"], source["track_sha256"]
    evaluation = Path(config.evaluation or newest_evaluation(results_of(checkpoint), weights, track))
    preset = name_of_preset(trained.env.preset)
    how = f"Make it with: {command('evaluate')} checkpoint={shlex.quote(config.checkpoint)} episodes=100"
    return {
        "algorithm": trained.algorithm,
        "track": Path(trained.track).name,
        "decoys": trained.decoys,
        "preset": Path(trained.env.preset).name,
        "control_rate": trained.env.control_rate,
        "env_steps": source["env_steps"],
        "weights": source["weights"],
        "training": training,
        "evaluation": read_evaluation(evaluation, checkpoint, weights, trained.track, track, preset, how),
    }


def history_of(checkpoint: Path, env_steps: int) -> list[dict[str, Any]]:
    """Return a run's starts before a checkpoint at `env_steps`, without overrides that are specific to a machine."""
    return [
        start | {"overrides": without_machine(start["overrides"])}
        for start in RunDirectory(config_folder(checkpoint)).run.read_starts()
        if start["env_steps"] < env_steps
    ]


def without_machine(overrides: Iterable[str]) -> list[str]:
    """Return overrides without those that are specific to a machine, and of a track's or drone's file only the name."""
    kept = [text for text in overrides if override_key(text) not in MACHINE_SETTINGS]
    names = {text: override_key(text) for text in kept if override_key(text) in ("track", "env.preset")}
    files = {text: as_override(name, Path(str(override_value(text))).name) for text, name in names.items()}
    return [files.get(text, text) for text in kept]


def write_agent(folder: Path, trained: WorldModelRunConfig, about: dict[str, Any]) -> None:
    """Write the configuration, and last agent.json, which makes the folder an agent."""
    (folder / AGENT).unlink(missing_ok=True)
    if trained.env.reward is not None:
        print(f"reward: the agent ships without env.reward={trained.env.reward}; its evaluations use Eq. 1")
    track, preset = Path(trained.track).name, Path(trained.env.preset).name  # no folders of this machine
    env = replace(trained.env, device="cpu", reward=None, preset=preset)
    RunDirectory(folder).keep_drone(trained.env.preset)
    ships = replace(trained, track=track, run_dir=None, resume=None, device="auto", env=env)
    OmegaConf.save(OmegaConf.structured(ships), folder / CONFIG)
    (folder / AGENT).write_text(json.dumps(about, indent=2, allow_nan=False) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
