"""Refuse overrides that would have no effect; messages name them as they are written, with their values."""

from __future__ import annotations

from collections.abc import Sequence

from omegaconf import DictConfig, OmegaConf

from composing.entry import override_key
from dreamer_racing.experience.replay import Storage
from dreamer_racing.losses import Barlow, Image, State, Target, find_targets


def check_overrides(config: DictConfig, overrides: Sequence[str]) -> None:
    """Refuse a task without `env=dmc`, and a track or decoys with it: one of them would be ignored."""
    given, suite = {override_key(override) for override in overrides}, config.env.suite
    if suite == "race" and "task" in given:
        raise ValueError(f"task={config.task} is for the Control Suite: add env=dmc, or leave it out to race.")
    if suite != "race" and config.decoys:
        raise ValueError(f"decoys={config.decoys} are for races, and env.suite={suite}: leave them out.")
    if "track_description" in given:
        raise ValueError("track_description= is set by the run from its track file: give track=my_track.yaml.")
    if suite != "race" and "track" in given:
        raise ValueError(f"track={config.track} is for races, and env.suite={suite}: leave one of them out.")


def check_read(config: DictConfig, overrides: Sequence[str]) -> None:
    """Refuse settings that the chosen losses and replay do not read; losses of the user's own may read all.

    Args:
        config: composed.
        overrides: as the user wrote them; settings from the file of a group are not refused.
    """
    targets = find_targets(config.loss.world_model)

    def have(reader: type[Target]) -> bool:
        return any(issubclass(kind, reader) or not kind.__module__.startswith("dreamer_racing.") for kind in targets)

    images = have(Image) and config.env.from_pixels
    waits = config.algorithm != "latent_ppo" or config.schedule.wait_for_model is not None
    drift = config.loss.drift_scale == 0 or (config.replay.context and not config.model.sampled)
    given = {override_key(override) for override in overrides}
    for name, read, reader in (
        ("loss.image_scale", images, "loss=reconstruction or informed, from images"),
        ("loss.image_share", images, "loss=reconstruction or informed, from images"),
        ("loss.privileged_scale", have(State), "loss=privileged or informed"),
        ("loss.barlow_scale", have(Barlow), "loss=decoder_free"),
        ("model.imagination_starts", config.algorithm == "dreamer_v3", "recipes/dreamer_v3.py, which imagines"),
        ("model.imagination_every", config.algorithm == "dreamer_v3", "recipes/dreamer_v3.py, which imagines"),
        ("loss.drift_scale", drift, "stored latents (replay.context=true) without sampling (model.sampled=false)"),
        ("replay.recent_records", config.replay.recent_share > 0, "replay.recent_share above 0"),
        ("replay.device", config.replay.storage is Storage.tensor, "replay.storage=tensor"),
        ("schedule.wait_every", waits, "schedule.wait_for_model"),
    ):
        if name in given and not read and (value := OmegaConf.select(config, name)) is not None:
            raise ValueError(f"{name}={value} is for {reader}, which is not chosen: choose that, or leave {name}= out.")
