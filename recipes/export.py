"""Export a trained actor for flight: ONNX, a torch.export program, and the contract of both.

    python recipes/export.py checkpoint=runs/dreamer_v3_kidney_20260101-120000 output=exports/kidney/actor.onnx

Flies the policy on the track that it was trained on, replays that flight through every copy, and writes them only if
they do the same; then measures how long a step takes. What flies them is dreamer_racing/onnx_actor.py.
"""

import logging
import sys
from pathlib import Path
from typing import cast

import hydra
import torch
from arena import camera_of, is_race, trained_config
from command_line import plain_errors, start_logging
from omegaconf import DictConfig, OmegaConf
from schema import DreamerConfig, ExportConfig, register

from dreamer_racing.checkpoint import latest_checkpoint
from dreamer_racing.envs.torchrl_env import DroneRacingEnv
from dreamer_racing.export import (
    LATENTS,
    ActorStep,
    MissingPackagesError,
    check_output,
    export_actor,
    load_agent,
    make_step,
)
from dreamer_racing.export_contract import make_contract
from dreamer_racing.export_parity import Flight, ParityError, TorchActor, episode_steps, record_flight
from dreamer_racing.modules import Interface
from dreamer_racing.onnx_actor import CONTRACT, OnnxActor, measure_latency, read_contract

register()


@hydra.main(version_base="1.3", config_path="config", config_name="export")
def main(config: DictConfig) -> None:
    """Restore the policy, fly it, export it, compare, measure."""
    start_logging()
    # Its exporter says four times that torchvision is not installed, which nothing here needs.
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    torch.set_num_threads(1)
    try:
        with plain_errors():
            export(cast(ExportConfig, OmegaConf.to_object(config)))
    except (ParityError, MissingPackagesError) as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(1) from error


def export(config: ExportConfig) -> None:
    """Do all of it, and print what came of it."""
    if config.latent not in LATENTS:
        raise ValueError(f"latent={config.latent}: there are {' and '.join(LATENTS)}.")
    checkpoint = latest_checkpoint(config.checkpoint)
    run_dir = checkpoint.parent.parent
    trained = trained_config(run_dir)
    if not isinstance(trained, DreamerConfig):
        raise ValueError(f"{checkpoint} was trained by {trained.algorithm}; this recipe exports actors of dreamer_v3.")
    if not is_race(trained):
        raise ValueError(f"{checkpoint} was trained on {trained.task}; this recipe exports actors that race.")
    output = check_output(config.output or run_dir / "export" / "actor.onnx")
    print(f"checkpoint: {checkpoint}")
    step, contract, flight = prepare(config, trained, checkpoint)
    deviation = export_actor(step, contract, flight, output, config.seed)
    print(f"replayed: {len(flight.actions)} steps, {flight.episodes} episodes, no latent flipped")
    for name, value in deviation.items():
        print(f"largest deviation of an action, {name} from torch: {value:.1e}")
    measure(step, flight, output)
    print(f"written to {output.parent}: {output.name}, {output.with_suffix('.pt2').name}, {CONTRACT}")


def prepare(
    config: ExportConfig, trained: DreamerConfig, checkpoint: Path
) -> tuple[ActorStep, dict[str, object], Flight]:
    """Restore the policy, fly it, and describe the step that is to be exported."""
    env = DroneRacingEnv(
        trained.track,
        1,
        from_pixels=trained.env.from_pixels,
        preset=trained.env.preset,
        control_rate=trained.env.control_rate,
        seed=config.seed,
        episode_steps=episode_steps(config.steps),
        camera=camera_of(trained),
        renderer=config.renderer,
        num_threads=1,
    )
    try:
        agent, metadata = load_agent(checkpoint, Interface.of(env))
        step = make_step(agent, config.latent)
        flight = record_flight(env, agent, config.steps)
    finally:
        env.close()
    contract = make_contract(
        step,
        env.worlds.parameters,
        env.worlds.camera,
        checkpoint=checkpoint.name,
        env_steps=metadata["env_steps"],
        track=trained.track,
        preset=trained.env.preset,
    )
    return step, contract, flight


def measure(step: ActorStep, flight: Flight, output: Path) -> None:
    """Print how long one step takes, with one thread."""
    contract = read_contract(output.parent / CONTRACT)
    for name, actor in (("onnxruntime", OnnxActor(output)), ("torch", TorchActor(contract, step))):
        print(f"one step, 1 thread, {name}: {measure_latency(actor.step, flight.observations)}")


if __name__ == "__main__":
    main()
