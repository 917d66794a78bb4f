"""Evaluation of a policy over a number of whole episodes.

Shapes: N environments, K steps of an episode, A action (4).
"""

from __future__ import annotations

import json
import math
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from dreamer_racing.envs.race.gates import CrashCause
from dreamer_racing.evaluation.trajectory import CRASHES, FINISHED, TIMEOUT, Trajectory, TrajectoryRecorder
from dreamer_racing.learners.learner import ValueFunction


@dataclass(frozen=True)
class Episode:
    """Statistics of one whole episode.

    Args:
        reward_sum: undiscounted return, at the environment's current b₂.
        length: control steps.
        duration: s.
        gates_passed: number of gates.
        outcome: ``finished``, ``timeout`` or one of ``CRASHES``.
        lap_times: time of each complete lap, s; the first one starts at rest.
        gate_offsets: distance from the gate's centre at each pass, m.
        speed_max: m/s.
        speed_mean: m/s.
        action_change_mean: mean norm of the change of the action from one control step to the next, in units of the
            action, whose four entries lie in [−1, 1]; 0 for an episode of one step.
        saturation_share: share of time in which a motor command was at a limit.
        thrust_shortfall: share of the commanded collective thrust that the motor commands lack, because of motor limits
            or because the mixer gives priority to body rates.
        crash_gate: index of the next gate when the drone crashed, from 0; None without a crash.
    """

    reward_sum: float
    length: int
    duration: float
    gates_passed: int
    outcome: str
    lap_times: list[float]
    gate_offsets: list[float]
    speed_max: float
    speed_mean: float
    action_change_mean: float
    saturation_share: float
    thrust_shortfall: float
    crash_gate: int | None


@dataclass(frozen=True)
class Evaluation:
    """Episodes of an evaluation and their statistics.

    Args:
        episodes: all episodes, in the order in which they were assigned to the environments.
        num_gates: number of race gates of the track.
        trajectories: the recorded episodes.
    """

    episodes: list[Episode]
    num_gates: int
    trajectories: list[Trajectory] = field(default_factory=list)

    @property
    def success_rate(self) -> float:
        """Share of episodes in which all laps were finished without a crash."""
        return _mean([episode.outcome == FINISHED for episode in self.episodes])

    @property
    def timeout_rate(self) -> float:
        """Share of episodes that ran out of time."""
        return _mean([episode.outcome == TIMEOUT for episode in self.episodes])

    @property
    def crashes(self) -> dict[str, int]:
        """Number of episodes that ended by each crash cause, zeros included."""
        return {cause: sum(episode.outcome == cause for episode in self.episodes) for cause in CRASHES}

    @property
    def crashes_by_gate(self) -> dict[str, list[int]]:
        """Number of crashes by cause and by the index of the next gate."""
        return {
            cause: [
                sum(episode.outcome == cause and episode.crash_gate == gate for episode in self.episodes)
                for gate in range(self.num_gates)
            ]
            for cause in CRASHES
        }

    @property
    def gates_per_episode(self) -> float:
        """Mean number of gates passed in an episode."""
        return _mean([episode.gates_passed for episode in self.episodes])

    @property
    def return_mean(self) -> float:
        """Mean undiscounted return."""
        return _mean([episode.reward_sum for episode in self.episodes])

    @property
    def return_std(self) -> float:
        """Standard deviation of the return over these episodes (0 for a single one)."""
        mean = self.return_mean
        return _mean([(episode.reward_sum - mean) ** 2 for episode in self.episodes]) ** 0.5

    @property
    def episode_length(self) -> float:
        """Mean number of control steps of an episode."""
        return _mean([episode.length for episode in self.episodes])

    @property
    def lap_times(self) -> list[float]:
        """Times of all complete laps, including those of episodes that crashed later, s."""
        return [time for episode in self.episodes for time in episode.lap_times]

    @property
    def lap_time_best(self) -> float | None:
        """Time of the fastest complete lap, s; None if there was no lap."""
        return min(self.lap_times, default=None)

    @property
    def lap_time_mean(self) -> float | None:
        """Mean time of a complete lap, s; None if there was no lap."""
        return _mean(self.lap_times) if self.lap_times else None

    @property
    def speed_max(self) -> float:
        """Highest speed at the end of any control step, m/s."""
        return max(episode.speed_max for episode in self.episodes)

    @property
    def speed_mean(self) -> float:
        """Mean speed over all control steps, m/s."""
        return self._mean_over_steps("speed_mean")

    @property
    def gate_offset_mean(self) -> float | None:
        """Mean distance from the gate's centre at a pass, m; None if no gate was passed."""
        offsets = [offset for episode in self.episodes for offset in episode.gate_offsets]
        return _mean(offsets) if offsets else None

    @property
    def action_change_mean(self) -> float:
        """Mean norm of the action's change over all pairs of successive control steps of an episode; 0 is smoothest."""
        changes = sum(episode.action_change_mean * (episode.length - 1) for episode in self.episodes)
        return changes / max(1, sum(episode.length - 1 for episode in self.episodes))

    @property
    def saturation_share(self) -> float:
        """Share of time in which a motor command was at a limit, over all episodes."""
        return self._mean_over_steps("saturation_share")

    @property
    def thrust_shortfall(self) -> float:
        """Mean thrust shortfall of the episodes, weighted by their lengths; see `Episode`."""
        return self._mean_over_steps("thrust_shortfall")

    def _mean_over_steps(self, statistic: str) -> float:
        total = sum(getattr(episode, statistic) * episode.length for episode in self.episodes)
        return total / sum(episode.length for episode in self.episodes)

    @classmethod
    def join(cls, parts: Sequence[Evaluation]) -> Evaluation:
        """Concatenate evaluations on tracks with the same number of gates, in order."""
        return cls(
            [episode for part in parts for episode in part.episodes],
            parts[0].num_gates,
            [trajectory for part in parts for trajectory in part.trajectories],
        )

    def to_dict(self) -> dict[str, Any]:
        """Return all statistics and, under ``episodes``, every episode, as JSON values."""
        names = (
            "success_rate", "gates_per_episode", "lap_time_best", "lap_time_mean", "speed_max", "speed_mean",
            "gate_offset_mean", "action_change_mean", "saturation_share", "thrust_shortfall", "crashes",
            "crashes_by_gate", "timeout_rate", "return_mean", "return_std", "episode_length",
        )  # fmt: skip
        statistics = {name: getattr(self, name) for name in names}
        return {"num_episodes": len(self.episodes), **statistics, "episodes": [asdict(e) for e in self.episodes]}

    def to_json(self) -> str:
        """Return ``to_dict`` as the text of ``evaluation.json``."""
        return json.dumps(self.to_dict(), indent=2, allow_nan=False) + "\n"

    def summary(self) -> str:
        """Return a human-readable table."""
        crashes = ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in self.crashes.items() if count)
        finished = sum(episode.outcome == FINISHED for episode in self.episodes)
        timeouts = sum(episode.outcome == TIMEOUT for episode in self.episodes)
        best, mean, offset = (
            "–" if value is None else f"{value:.2f} {unit}"
            for value, unit in ((self.lap_time_best, "s"), (self.lap_time_mean, "s"), (self.gate_offset_mean, "m"))
        )
        rows = (
            ("episodes", f"{len(self.episodes)}, {self.episode_length:.0f} steps on average"),
            ("finished", f"{finished} ({self.success_rate:.0%}); {timeouts} ran out of time"),
            ("crashed", crashes or "0"),
            ("gates per episode", f"{self.gates_per_episode:.2f}"),
            ("lap time", f"best {best}, mean {mean} ({len(self.lap_times)} laps)"),
            ("speed", f"max {self.speed_max:.1f} m/s, mean {self.speed_mean:.1f} m/s"),
            ("gate offset", f"mean {offset}"),
            ("action change", f"mean {self.action_change_mean:.3f} a step"),
            ("motors", f"at a limit {self.saturation_share:.1%}, thrust missing {self.thrust_shortfall:.1%}"),
            ("return", f"{self.return_mean:.1f} ± {self.return_std:.1f}"),
        )
        return "\n".join(f"{name:<18} {value}" for name, value in rows)


@torch.no_grad()
def evaluate(
    env: EnvBase,
    policy: Callable[[TensorDictBase], TensorDictBase],
    episodes: int,
    *,
    exploration_type: ExplorationType = ExplorationType.DETERMINISTIC,
    num_trajectories: int = 1,
    record_pixels: bool = True,
    value_function: ValueFunction | None = None,
    on_episode: Callable[[int, int], None] | None = None,
    on_step: Callable[[TensorDictBase], None] | None = None,
) -> Evaluation:
    """Evaluate a policy over exactly ``episodes`` whole episodes.

    Episodes are assigned to the environments beforehand (number k to environment k mod N), so that the length of an
    episode does not affect whether it counts. Images are kept only in recordings.

    Args:
        env: a `DroneRacingEnv` with ``evaluation=True``, batch size [N], or a `TransformedEnv` of one (`InitTracker`,
            `TensorDictPrimer`) as the policy needs. It is reset first, and left in the middle of episodes.
        policy: function that writes ``action``; set its mode beforehand (for instance ``DreamerPolicy.deterministic``).
        episodes: number of episodes.
        exploration_type: what TorchRL's probabilistic policies return: mode or sample.
        num_trajectories: number of environments whose first episode is recorded.
        record_pixels: whether to record observations (``pixels``, ``imu``, ``vector``); images take 12 KB a step.
        value_function: computes a value for each recorded step; None: recordings have no values.
        on_episode: called with the numbers of finished and of all episodes, after each step in which one finished.
        on_step: called before each step with the policy's observation, see `RaceWindow.show`.

    Returns:
        The episodes and the recordings.

    Raises:
        ValueError: ``env`` is no evaluation environment or lacks entries to measure, or ``episodes`` is below 1.

    Example:
        >>> from tensordict.nn import TensorDictModule
        >>> from dreamer_racing.envs import DroneRacingEnv
        >>> env = DroneRacingEnv("circle", num_envs=2, from_pixels=False, evaluation=True, episode_steps=5)
        >>> policy = TensorDictModule(lambda position: torch.zeros(2, 4), [("privileged", "position")], ["action"])
        >>> evaluate(env, policy, episodes=3).episode_length
        5.0
    """
    control_dt = _check(env, episodes)
    num_envs = env.batch_size[0]
    shares = split_episodes(episodes, num_envs)
    begun: list[dict[str, list[float]]] = [defaultdict(list) for _ in range(num_envs)]  # of the current episodes
    flown: list[list[Episode]] = [[] for _ in range(num_envs)]
    with set_exploration_type(exploration_type):
        tensordict = env.reset()
        recorded = min(num_trajectories, num_envs, episodes)
        recorder = TrajectoryRecorder(tensordict, recorded, record_pixels)
        action = torch.zeros(env.action_spec.shape, device=env.device)
        while any(len(done) < share for done, share in zip(flown, shares, strict=True)):
            if on_step:
                on_step(tensordict)
            acted = policy(tensordict)
            judged = value_function(acted[:recorded]) if value_function and recorder.running else None
            tensordict, following = env.step_and_maybe_reset(acted)
            # As the environment applies them: clipped, and zero for non-finite entries.
            action, action_before = tensordict["action"].float().nan_to_num(0.0, 0.0, 0.0).clamp(-1.0, 1.0), action
            change = (action - action_before).norm(dim=-1, keepdim=True)
            steps = _read_step(tensordict["next"], change, env.worlds.effort)
            outcomes, before = [_outcome(step) for step in steps], sum(map(len, flown))
            for index, (step, outcome) in enumerate(zip(steps, outcomes, strict=True)):
                if len(flown[index]) < shares[index]:
                    for name, value in step.items():
                        begun[index][name].append(value)
                    if outcome is not None:
                        flown[index].append(_summarise(begun[index], outcome, control_dt))
                        begun[index].clear()
            if on_episode and (ended := sum(map(len, flown))) > before:
                on_episode(ended, episodes)
            recorder.add(tensordict, outcomes, judged)
            tensordict = following
    waves = range(max(shares))
    ordered = [flown[index][wave] for wave in waves for index in range(num_envs) if wave < shares[index]]
    seen = env.observation_spec.keys()
    tilt = env.worlds.camera.tilt if "pixels" in seen else None
    return Evaluation(ordered, env.worlds.track.num_gates, recorder.trajectories(control_dt, tilt))


def split_episodes(episodes: int, worlds: int) -> list[int]:
    """Return the number of episodes for each of the worlds, which differ by one at most."""
    return [episodes // worlds + (index < episodes % worlds) for index in range(worlds)]


def _check(env: EnvBase, episodes: int) -> float:
    """Check the arguments of `evaluate`; return the duration of a control step, s."""
    if episodes < 1:
        raise ValueError(f"episodes={episodes}: at least one episode is needed.")
    if len(env.batch_size) != 1:
        raise ValueError(f"env has batch size {list(env.batch_size)}; evaluate() needs one batch dimension, [N].")
    if not env.worlds.evaluation:
        raise ValueError(
            "env is a training environment: its episodes begin at random places and never finish. "
            "Make it with DroneRacingEnv(..., evaluation=True)."
        )
    if ("privileged", "linear_velocity") not in env.observation_spec.keys(include_nested=True):
        raise ValueError(
            "env has no ('privileged', ...) entries, which give speeds and paths: make it with privileged=True."
        )
    return float(env.worlds.parameters.control_dt)


def _read_step(after: TensorDictBase, action_change: Tensor, effort: Tensor) -> list[dict[str, float]]:
    """Return the measurements of one step, one dictionary per environment, with a single device transfer.

    Of the tensordict under ``next``, the change's norm (N, 1), and motor effort (N, 3), see `RaceWorlds.effort`.
    """
    columns = {
        "action_change": action_change,
        **dict(zip(("saturated", "thrust_asked", "thrust_missing"), effort.split(1, dim=1), strict=True)),
        "target_gate": after["privileged", "target_gate"],
        "reward": after["reward"],
        "done": after["done"],
        "speed": after["privileged", "linear_velocity"].norm(dim=-1, keepdim=True),
        **{name: after["race", name] for name in ("crash", "finished", "gates_passed", "gate_offset", "lap_time")},
    }
    rows = torch.cat([column.double() for column in columns.values()], dim=-1).tolist()  # (N, columns)
    return [dict(zip(columns, row, strict=True)) for row in rows]


def _outcome(step: dict[str, float]) -> str | None:
    """Return the outcome if the episode ended in this step, else None."""
    if not step["done"]:
        return None
    if step["crash"]:
        return CrashCause(int(step["crash"])).name.lower()
    return FINISHED if step["finished"] else TIMEOUT


def _summarise(values: dict[str, list[float]], outcome: str, control_dt: float) -> Episode:
    speeds = [speed for speed in values["speed"] if speed < math.inf] or [0.0]  # a diverged state has no speed
    changes = values["action_change"][1:]  # the first is relative to the previous episode
    passed = values["gates_passed"]
    passes = zip(values["gate_offset"], [0, *passed], passed, strict=False)
    return Episode(
        reward_sum=sum(values["reward"]),
        length=len(passed),
        duration=len(passed) * control_dt,
        gates_passed=int(passed[-1]),
        outcome=outcome,
        lap_times=[time for time in values["lap_time"] if time > 0],
        gate_offsets=[offset for offset, before, after in passes if after > before],
        speed_max=max(speeds),
        speed_mean=_mean(speeds),
        action_change_mean=_mean(changes) if changes else 0.0,
        saturation_share=_mean(values["saturated"]),
        thrust_shortfall=sum(values["thrust_missing"]) / max(sum(values["thrust_asked"]), 1e-9),
        crash_gate=int(values["target_gate"][-1]) if outcome in CRASHES else None,
    )


def _mean(values: list[Any]) -> float:
    return float(sum(values) / len(values))
