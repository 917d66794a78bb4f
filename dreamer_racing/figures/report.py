"""Reports of evaluations: numbers, a plot of the flight, and films, of a world model's predictions and from outside."""

import json
import math
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torchrl.envs import EnvBase

from dreamer_racing.envs.policy_memory import with_memory
from dreamer_racing.envs.simulator.chase import ChaseView
from dreamer_racing.envs.tracks import Track
from dreamer_racing.evaluation.course import Course, act
from dreamer_racing.evaluation.dreams import Painter, dream, find_painter, record_dream
from dreamer_racing.evaluation.evaluate import Evaluation, Trajectory, split_episodes
from dreamer_racing.evaluation.protocol import Result
from dreamer_racing.evaluation.trajectory import write_flight
from dreamer_racing.figures.film import (
    GAP,
    GIF_SIZE,
    caption,
    dream_words,
    enlarge,
    enlarge_to_watch,
    onboard_beside_map,
    race_words,
    second_lap,
    side_by_side,
    slow_motion,
    write_gif,
    write_video,
)
from dreamer_racing.figures.flights import plot_top_down
from dreamer_racing.learners.learner import Evaluable
from dreamer_racing.learners.update import WorldModelLearner
from dreamer_racing.training.directory import EVALUATION, RunDirectory

GIF_STRIDE = 2  # control steps a frame: 25 frames a second
CHASE_STRIDE, CHASE_COLORS = 3, 32  # control steps a frame, and colours, of chase.gif, in which all of it moves
SEEN_STEPS, DREAMT_STEPS = 10, 40  # control steps observed by the model, then predicted open loop, in the video


class EvaluationReport:
    """Evaluates a learner's policy and writes numbers, plot and video into the run directory.

    ``worlds`` are arguments of `DroneRacingEnv`: track, preset, renderer, camera. The environment is seeded before each
    evaluation, so that all have the same starts and drones. The video has at most ``video_steps`` control steps.
    """

    def __init__(
        self,
        directory: str | Path,
        learner: Evaluable,
        worlds: dict[str, Any],
        episodes: int,
        video_steps: int = 500,
        num_envs: int | None = None,
        seed: int = 0,
    ) -> None:
        self.directory = RunDirectory(Path(directory))
        self.episodes = episodes
        self.video_steps = video_steps
        self.on_episode: Callable[[int, int], None] | None = None
        self.attempt: Callable[[str], AbstractContextManager] = nullcontext
        self._learner = learner
        self._course = Course(learner.evaluation_policy(), {**worlds, "seed": seed}, episodes, num_envs)

    def make(self, env_steps: int, stochastic: bool = False) -> dict[str, float]:
        """Evaluate the deterministic policy and, if ``stochastic``, the stochastic one; write all files.

        Returns metrics `evaluation/...` and `evaluation_stochastic/...`.
        """
        metrics: dict[str, float] = {}
        for suffix in ("", "_stochastic") if stochastic else ("",):
            result = self.evaluate(deterministic=not suffix)
            with self.attempt("evaluations, plots and videos"):
                self.write(f"{env_steps:09d}{suffix}", result)
            numbers = {name: value for name, value in result.to_dict().items() if isinstance(value, (int, float))}
            metrics |= {f"evaluation{suffix}/{name}": float(value) for name, value in numbers.items()}
        return metrics

    def evaluate(self, deterministic: bool) -> Evaluation:
        """Run the episodes."""
        value_function = self._learner.value_function()
        return self._course.evaluate(deterministic, value_function=value_function, on_episode=self.on_episode)

    def write(self, name: str, result: Evaluation) -> None:
        """Write `evaluations/<name>.json`, `plots/<name>.png` and, with images, `videos/<name>.mp4`.

        For later figures, also write `evaluations/<name>_trajectory.csv`, with images `<name>_onboard.npz`, and with a
        world model that decodes images or the true state `<name>_dream.npz`.
        """
        into = self.directory
        for folder in (into.evaluations, into.plots, into.videos):
            folder.mkdir(parents=True, exist_ok=True)
        (into.evaluations / f"{name}.json").write_text(json.dumps(result.to_dict(), indent=2))
        trajectory = result.trajectories[0]
        write_flight(into.evaluations / name, trajectory, self._course.base.track)
        plot_top_down(self._course.base.track, trajectory, into.plots / f"{name}.png")
        if trajectory.pixels is None:
            return
        painter = None
        if isinstance(self._learner, WorldModelLearner):
            painter = find_painter(self._learner, self._course.base.worlds)
            if (recorded := record_dream(self._learner, trajectory, painter)) is not None:
                recorded.save(into.evaluations / f"{name}_dream.npz")
        self._film(into.videos / f"{name}.mp4", trajectory, painter)

    def _film(self, path: Path, trajectory: Trajectory, painter: Painter | None) -> None:
        """Write a video of the flight, with a painter also of the model's predictions; short flights in slow motion."""
        assert trajectory.pixels is not None
        count = min(len(trajectory.pixels), self.video_steps)
        if painter is None or not isinstance(self._learner, WorldModelLearner):
            frames, right = enlarge_to_watch(trajectory.pixels[:count].numpy()), list[str]()
        else:
            frames = dream_beside_flight(self._learner, trajectory, painter, count)
            right = dream_words(count, SEEN_STEPS, trajectory.control_dt, SEEN_STEPS + DREAMT_STEPS)
        slower = slow_motion(count * trajectory.control_dt)
        slowed = f"  {slower}x slower" if slower > 1 else ""
        left = [words + slowed for words in race_words(self._course.base.track, trajectory)[:count]]
        write_video(path, caption(frames, left, right), fps=1 / (slower * trajectory.control_dt))

    def close(self) -> None:
        """Close the evaluation's simulator."""
        self._course.close()


class ReturnReport:
    """Evaluates a learner's policy in any environment by its returns, and records a video of one episode.

    The environment has batch size [N], with `pixels` or `vector`; episodes are assigned to the N environments
    beforehand. It is seeded before each evaluation, so that all have the same starts, even after resuming.
    """

    def __init__(
        self,
        directory: str | Path,
        learner: Evaluable,
        env: EnvBase,
        episodes: int,
        video_steps: int = 500,
        seed: int = 0,
    ) -> None:
        self.directory = RunDirectory(Path(directory))
        self.episodes = episodes
        self.video_steps = video_steps
        self.on_episode: Callable[[int, int], None] | None = None
        self.attempt: Callable[[str], AbstractContextManager] = nullcontext
        self._learner = learner
        self._policy = learner.evaluation_policy()
        self._env = with_memory(env, self._policy.make_primer())
        self._seed = seed

    def make(self, env_steps: int, stochastic: bool = False) -> dict[str, float]:
        """Evaluate and write as `EvaluationReport.make`."""
        metrics: dict[str, float] = {}
        for suffix in ("", "_stochastic") if stochastic else ("",):
            self._policy.deterministic = not suffix
            returns, lengths, frames = self._act()
            numbers = {
                "num_episodes": float(len(returns)),
                "return_mean": returns.mean().item(),
                "return_std": returns.std(correction=0).item(),
                "episode_length": lengths.mean().item(),
            }
            with self.attempt("evaluations and videos"):
                self._write(f"{env_steps:09d}{suffix}", {**numbers, "returns": returns.tolist()}, frames)
            metrics |= {f"evaluation{suffix}/{name}": value for name, value in numbers.items()}
        return metrics

    @torch.no_grad()
    def _act(self) -> tuple[Tensor, Tensor, list[Tensor]]:
        """Return the episodes' returns and lengths ``(episodes,)`` and the images of environment 0's first episode."""
        num_envs = self._env.batch_size[0]
        left = torch.tensor(split_episodes(self.episodes, num_envs))
        total, length = torch.zeros(num_envs), torch.zeros(num_envs)  # (N,) of the current episodes
        returns, lengths, frames, filming = [], [], [], True
        self._env.set_seed(self._seed)
        tensordict = self._env.reset()
        while (left > 0).any():
            if filming and "pixels" in tensordict:
                frames.append(tensordict["pixels"][0].clone())
            step, tensordict = self._env.step_and_maybe_reset(act(self._policy, tensordict))
            total, length = total + step["next", "reward"].view(-1), length + 1
            done = step["next", "done"].view(-1)
            counted = done & (left > 0)
            if self.on_episode and counted.any():
                self.on_episode(self.episodes - int(left.sum() - counted.sum()), self.episodes)
            returns.append(total[counted])
            lengths.append(length[counted])
            left, total, length = left - counted.long(), total.masked_fill(done, 0), length.masked_fill(done, 0)
            filming = filming and not done[0] and len(frames) < self.video_steps
        return torch.cat(returns), torch.cat(lengths), frames

    def _write(self, name: str, numbers: dict[str, Any], frames: list[Tensor]) -> None:
        into = self.directory
        for folder in (into.evaluations, into.videos):
            folder.mkdir(parents=True, exist_ok=True)
        (into.evaluations / f"{name}.json").write_text(json.dumps(numbers, indent=2))
        if frames:
            write_video(into.videos / f"{name}.mp4", torch.stack(frames), fps=30, scale=None)

    def close(self) -> None:
        """Close the evaluation's environments."""
        self._env.close(raise_if_closed=False)


def dream_beside_flight(learner: WorldModelLearner, trajectory: Trajectory, painter: Painter, steps: int) -> np.ndarray:
    """Compose on-board view | the world model's prediction, alternating between context and open loop.

    Returns uint8 frames (steps, height, width, 3).
    """
    assert trajectory.pixels is not None
    shown = []
    for start in range(0, steps, SEEN_STEPS + DREAMT_STEPS):
        part = slice(start, min(start + SEEN_STEPS + DREAMT_STEPS, steps))
        seen = min(SEEN_STEPS, part.stop - start)
        dreamt = dream(learner, trajectory, painter, part, seen)
        shown.append(side_by_side(trajectory.pixels[part], dreamt, seen))
    return np.concatenate(shown)


def report_condition(into: RunDirectory, result: Result, video_steps: int) -> None:
    """Plot the first flight of a condition from above; film it, if it has images and the policy is deterministic."""
    trajectory = result.evaluation.trajectories[0]
    plot_top_down(result.track, trajectory, into.plots / f"{result.name}.png")
    if trajectory.pixels is not None and result.mode == "deterministic":
        frames = onboard_beside_map(result.track, trajectory.part(0, min(video_steps, len(trajectory.action))))
        film = caption(frames, race_words(result.track, trajectory)[: len(frames)])
        write_video(into.videos / f"{result.name}.mp4", film, fps=round(1 / trajectory.control_dt))


def report_flight(directory: Path, track: Track, result: Evaluation) -> str:
    """Write numbers and a plot of a flight, of one with images a video and a GIF of its second lap; name the files."""
    trajectory = result.trajectories[0]
    (directory / EVALUATION).write_text(result.to_json())
    stored = write_flight(directory / "flight", trajectory, track)
    plot_top_down(track, trajectory, directory / "top_down.png")
    for earlier in ("onboard.mp4", "onboard.gif", "chase.mp4", "chase.gif"):
        (directory / earlier).unlink(missing_ok=True)  # so that none is mistaken for this flight's
    files = f"{EVALUATION}, {', '.join(stored)}, top_down.png"
    if trajectory.pixels is None:
        return f"{files} (there is no video: the agent sees numbers)"
    words = race_words(track, trajectory)
    film = caption(enlarge_to_watch(trajectory.pixels.numpy()), words)
    filmed = write_video(directory / "onboard.mp4", film, fps=1 / trajectory.control_dt)
    first, last = second_lap(trajectory)
    frames = onboard_beside_map(track, trajectory.part(first, last), GIF_SIZE)[::GIF_STRIDE]
    gif = caption(frames, words[first : last + 1 : GIF_STRIDE])
    size = write_gif(directory / "onboard.gif", gif, fps=1 / (GIF_STRIDE * trajectory.control_dt))
    return f"{files}, {'onboard.mp4, ' if filmed else ''}onboard.gif ({size / 1e6:.2f} MB)"


def film_from_outside(directory: Path, view: ChaseView, track: Track, trajectory: Trajectory) -> str:
    """Write a video of the whole flight and a GIF of its second lap, from outside and by the drone; name the files."""
    frames, words = chase_beside_onboard(view, trajectory), race_words(track, trajectory)
    view.close()
    filmed = write_video(directory / "chase.mp4", caption(frames, words), fps=1 / trajectory.control_dt)
    first, last = second_lap(trajectory)
    shown = slice(first, last + 1, CHASE_STRIDE)
    gif, fps = caption(frames[shown], words[shown]), 1 / (CHASE_STRIDE * trajectory.control_dt)
    size = write_gif(directory / "chase.gif", gif, fps, CHASE_COLORS)
    return f"{'chase.mp4, ' if filmed else ''}chase.gif ({size / 1e6:.2f} MB)"


def chase_beside_onboard(view: ChaseView, trajectory: Trajectory) -> np.ndarray:
    """Compose chase view | on-board view, (K + 1, size, size + `GAP` + width, 3), or without images the chase view.

    On-board images are scaled by an integer factor and centred.
    """
    position, attitude = trajectory.position.double().numpy(), trajectory.attitude.double().numpy()
    gate, time = trajectory.target_gate.numpy(), trajectory.control_dt * np.arange(len(position))
    rows = (slice(row, row + 1) for row in range(len(position)))
    outside = np.concatenate([view.draw(position[row], attitude[row], gate[row], time[row]) for row in rows])
    if trajectory.pixels is None:
        return outside
    height = outside.shape[1]
    seen = enlarge(trajectory.pixels.numpy(), max(1, height // trajectory.pixels.shape[1]))
    if seen.shape[1] > height:
        seen = seen[:, :: math.ceil(seen.shape[1] / height), :: math.ceil(seen.shape[1] / height)]
    missing = height - seen.shape[1]
    seen = np.pad(seen, ((0, 0), (missing // 2, missing - missing // 2), (GAP, 0), (0, 0)), constant_values=255)
    return np.concatenate((outside, seen), axis=2)
