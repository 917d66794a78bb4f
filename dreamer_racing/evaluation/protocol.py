"""The evaluation protocol: the conditions under which a policy is evaluated, and the table of results.

See docs/evaluation.md for the metrics and their reasons. Shapes: N environments.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dreamer_racing.envs.drone.parameters import at_control_rate, load_preset
from dreamer_racing.envs.race.starts import StartSampler
from dreamer_racing.envs.simulator.looks import LooksRandomisation
from dreamer_racing.envs.tracks import Track, displace_gates, load_track
from dreamer_racing.evaluation.course import Course
from dreamer_racing.evaluation.evaluate import Evaluation, split_episodes
from dreamer_racing.learners.learner import Policy

EPISODES = 100
"""Minimum number of episodes per condition."""
PRESETS = ("easy", "faithful")
"""Physics that every agent is evaluated with, beside its own."""
MODES = ("deterministic", "stochastic")


@dataclass(frozen=True)
class Condition:
    """A condition: one way in which the evaluated race differs from the training race.

    Args:
        name: used in file names.
        meaning: a description.
        start_noise: noise of the start pose, as a multiple of the noise of training starts.
        camera_tilt: half-width of the uniform noise added to the camera's tilt in every episode, degrees.
        gate_shift: radius of the ball in which every gate is displaced, m.
        gate_turn: half-width of the uniform rotation of every gate, degrees.
        num_tracks: number of displaced tracks; episodes are split evenly among them.
    """

    name: str
    meaning: str
    start_noise: float = 0.0
    camera_tilt: float = 0.0
    gate_shift: float = 0.0
    gate_turn: float = 0.0
    num_tracks: int = 1

    @property
    def needs_images(self) -> bool:
        """Whether the condition affects only agents with a camera."""
        return self.camera_tilt > 0.0

    def races(self, track: Track, seed: int) -> Iterator[dict[str, Any]]:
        """Yield the arguments of `DroneRacingEnv` for each of the condition's tracks.

        Raises:
            TrackError: the gates cannot be displaced that far.
        """
        looks = None
        if self.camera_tilt:
            looks = LooksRandomisation(0.0, 0.0, 0.0, camera_tilt=self.camera_tilt, field_of_view=0.0, noise=0.0)
        for number in range(self.num_tracks):
            displaced = track
            if self.gate_shift or self.gate_turn:
                displaced = displace_gates(track, self.gate_shift, self.gate_turn, seed + number)
            yield {"track": displaced, "start_noise": self.start_noise, "looks": looks, "seed": seed + number}


CONDITIONS = (
    Condition("nominal", "the race as trained: from the start pose, at rest"),
    Condition(
        "start_noise",
        "starts within ±1.0/1.0/0.6 m, ±10° roll and pitch, ±20° yaw: twice the noise of training",
        start_noise=2.0,
    ),
    Condition("camera_tilt", "camera tilted by up to ±5° more or less than in training", camera_tilt=5.0),
    Condition(
        "gate_displacement",
        "every gate moved by up to 0.3 m and turned by up to ±10°: ten such tracks",
        gate_shift=0.3,
        gate_turn=10.0,
        num_tracks=10,
    ),
)
"""The conditions of the protocol, with numbers chosen by this project [choice]."""


@dataclass(frozen=True)
class Result:
    """Result of one condition with one physics preset and one mode of the policy."""

    preset: str  # name of the physics
    condition: str
    mode: str
    track: Track  # of the recorded flight; other flights may be on differently displaced tracks
    evaluation: Evaluation

    @property
    def name(self) -> str:
        """Name for files."""
        return f"{self.preset}_{self.condition}_{self.mode}"

    def to_dict(self) -> dict[str, Any]:
        """Return the statistics without the episodes, as JSON values."""
        statistics = self.evaluation.to_dict()
        del statistics["episodes"]
        return {"preset": self.preset, "condition": self.condition, "policy": self.mode, **statistics}


def presets_of(own: str) -> tuple[str, ...]:
    """Return the physics to evaluate with: `PRESETS`, and the agent's own, a preset or a drone file."""
    return tuple(dict.fromkeys((*PRESETS, own)))


def run_protocol(
    policy: Policy,
    worlds: Mapping[str, Any],
    episodes: int = EPISODES,
    *,
    conditions: Sequence[Condition] = CONDITIONS,
    num_envs: int | None = None,
    seed: int = 0,
) -> Iterator[Result]:
    """Evaluate a policy under all conditions, with each preset, in both modes, and yield the results.

    Conditions that affect only the camera are skipped for an agent without images.

    Args:
        policy: the policy.
        worlds: arguments of `DroneRacingEnv`: ``track``, ``preset``, ``camera``, ``renderer``, ``from_pixels``.
        episodes: number of episodes per condition.
        conditions: the conditions.
        num_envs: see `Course`.
        seed: seed of starts, displaced gates, physics and looks. Both modes and all policies get the same races, within
            the limits that `Course` describes.
    """
    track = load_track(worlds["track"])
    for preset in presets_of(worlds.get("preset", PRESETS[0])):
        for condition in conditions:
            if condition.needs_images and not worlds.get("from_pixels", True):
                continue
            races = list(condition.races(track, seed))
            shares = split_episodes(episodes, len(races))
            for mode in MODES:
                parts = []
                for race, share in zip(races, shares, strict=True):
                    if share:
                        there, recorded = {**worlds, "preset": preset, **race}, int(race is races[0])
                        deterministic = mode == "deterministic"
                        parts.append(fly(policy, there, share, deterministic, num_envs, num_trajectories=recorded))
                yield Result(Path(preset).name, condition.name, mode, races[0]["track"], Evaluation.join(parts))


def check_protocol(conditions: Sequence[Condition], track: Track, seed: int, preset: str, control_rate: float) -> None:
    """Check that the track leaves room for all conditions, and all physics allow the rate, before any is evaluated.

    Raises:
        ValueError: they do not; the message names the condition, or the physics.
    """
    for physics in presets_of(preset):
        try:
            at_control_rate(load_preset(physics), control_rate)
        except ValueError as error:
            raise ValueError(f"the protocol cannot be flown with preset={physics}: {error}") from error
    for condition in conditions:
        try:
            for race in condition.races(track, seed):
                StartSampler(race["track"], start_noise=race["start_noise"])
        except ValueError as error:
            raise ValueError(f"condition {condition.name} cannot be flown on {track.name}: {error}") from error


def fly(
    policy: Policy,
    worlds: Mapping[str, Any],
    episodes: int,
    deterministic: bool = True,
    num_envs: int | None = None,
    **recording: Any,
) -> Evaluation:
    """Evaluate a policy in environments made for it; arguments as in `Course` and `evaluate`."""
    course = Course(policy, worlds, episodes, num_envs)
    try:
        return course.evaluate(deterministic, **recording)
    finally:
        course.close()


def report_heading(title: str, provenance: dict[str, Any]) -> str:
    """Return the head of a Markdown report: the title, the command, and where the numbers come from."""
    facts = {name: value for name, value in provenance.items() if name != "command" and value is not None}
    text = "; ".join(f"{name.replace('_', ' ')} {value}" for name, value in facts.items())
    return f"# {title}\n\n```bash\n{provenance['command']}\n```\n\n{text}.\n"


def results_table(results: Sequence[Result], condition: str = "condition") -> str:
    """Return a Markdown table with one row per result; ``condition`` is the head of the column of conditions."""
    head = (
        "physics", condition, "policy", "success", "gates", "best lap (s)", "mean lap (s)", "top speed (m/s)",
        "mean speed (m/s)", "gate offset (m)", "action change", "crashes",
    )  # fmt: skip
    rows = []
    for result in results:
        flown = result.evaluation
        numbers = [f"{flown.success_rate:.0%}", f"{flown.gates_per_episode:.2f}"]
        numbers += [_number(flown.lap_time_best), _number(flown.lap_time_mean)]
        numbers += [f"{flown.speed_max:.1f}", f"{flown.speed_mean:.1f}"]
        numbers += [_number(flown.gate_offset_mean), f"{flown.action_change_mean:.3f}"]
        rows.append((result.preset, result.condition, result.mode, *numbers, crashes_in_words(flown)))
    return as_markdown(head, rows)


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.2f}"


def as_markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    return "\n".join("| " + " | ".join(row) + " |" for row in (head, ["---"] * len(head), *rows)) + "\n"


def crashes_in_words(evaluation: Evaluation) -> str:
    """Return the number of crashes as text, by cause and by the next gate, counted from 1."""
    words = []
    for cause, counts in evaluation.crashes_by_gate.items():
        places = [f"{count} at gate {gate}" for gate, count in enumerate(counts, start=1) if count]
        if places:
            words.append(f"{cause.replace('_', ' ')}: {', '.join(places)}")
    return "; ".join(words) or "none"
