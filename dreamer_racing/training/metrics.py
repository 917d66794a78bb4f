"""Metrics of a run: a CSV file over ``env_steps``, loggers beside it, and the episodes in a collector's rollouts.

Shapes: N environments, T steps a rollout, E finished episodes.
"""

from __future__ import annotations

import csv
import logging
import os
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from enum import IntEnum
from pathlib import Path
from types import TracebackType
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.record.loggers import Logger

from dreamer_racing.training.metrics_file import X_AXIS, read_rows

logger = logging.getLogger(__name__)


class MetricsLog:
    """Averages the metrics pushed since the last write and writes them to ``metrics.csv`` and to loggers.

    The file has one row a write and a column ``env_steps`` first; a metric that appears later gets a new column at the
    end, empty in earlier rows. Whatever the moment the process is killed, at most the row being written is lost.

    Args:
        run_dir: folder of the run.
        loggers: TorchRL loggers that receive every row too.
        tensorboard: also write TensorBoard files to ``run_dir/tensorboard``.
        resume_env_steps: of the checkpoint this run continues: rows beyond it are removed. If None, the run is new,
            and a ``metrics.csv`` already there is kept under another name.

    Example:
        >>> with MetricsLog("runs/example") as metrics:  # doctest: +SKIP
        ...     metrics.push({"loss/actor": torch.tensor(1.0)})
        ...     metrics.write(env_steps=1024)
    """

    def __init__(
        self,
        run_dir: str | Path,
        loggers: Sequence[Logger] = (),
        tensorboard: bool = False,
        resume_env_steps: int | None = None,
    ) -> None:
        run_dir = Path(run_dir)
        run_dir.mkdir(parents=True, exist_ok=True)
        self.path = run_dir / "metrics.csv"
        self.loggers = list(loggers)
        if tensorboard:
            from torchrl.record.loggers.tensorboard import TensorboardLogger

            self.loggers.append(TensorboardLogger(exp_name="tensorboard", log_dir=str(run_dir)))
        self._mean = RunningMean()
        self._columns = [X_AXIS]
        if resume_env_steps is None:
            _keep_aside(self.path)
            self._rewrite([])
        else:
            self._truncate(resume_env_steps)

    def push(self, metrics: Mapping[str, Tensor | float]) -> None:
        """Adds values to the averages; tensors stay on their device, so that nothing waits for it.

        Args:
            metrics: values by name; of a tensor of several elements the mean counts.
        """
        self._mean.push(metrics)

    def write(self, env_steps: int) -> dict[str, float]:
        """Writes the averages as one row and starts new ones. Waits for the device once.

        Args:
            env_steps: control steps summed over environments.

        Returns:
            The averages by name; empty, and no row written, if nothing was pushed.
        """
        values = self._mean.pop()
        if not values:
            return values
        new = [name for name in values if name not in self._columns]
        if new:
            rows = _read_rows(self.path)
            self._columns += new
            self._rewrite(rows)
        with self.path.open("a", newline="", encoding="utf-8") as file:
            row = {name: f"{value:.8g}" for name, value in values.items()}
            csv.DictWriter(file, self._columns).writerow({X_AXIS: env_steps, **row})
        for sink in self.loggers:
            for name, value in values.items():
                sink.log_scalar(name, value, step=env_steps)
        return values

    def close(self) -> None:
        """Closes the loggers that can be closed."""
        for sink in self.loggers:
            close = getattr(sink.experiment, "close", None)
            if close is not None:
                close()

    def __enter__(self) -> MetricsLog:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _truncate(self, env_steps: int) -> None:
        rows = _read_rows(self.path) if self.path.exists() else []
        kept = [row for row in rows if int(row[X_AXIS]) <= env_steps]
        if len(kept) < len(rows):
            logger.info("Removing %d rows beyond env_steps=%d from %s.", len(rows) - len(kept), env_steps, self.path)
        self._columns = list(rows[0]) if rows else [X_AXIS]
        self._rewrite(kept)

    def _rewrite(self, rows: Iterable[Mapping[str, str]]) -> None:
        partial = self.path.with_name(f".{self.path.name}.partial")
        with partial.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, self._columns, restval="")
            writer.writeheader()
            writer.writerows(rows)
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, self.path)


def _read_rows(path: Path) -> list[dict[str, str]]:
    """Read the complete rows."""
    header, rows, _ = read_rows(path)
    return [dict(zip(header, row, strict=True)) for row in rows]


def _keep_aside(path: Path) -> None:
    if not path.exists():
        return
    number = 1
    while (other := path.with_name(f"{path.stem}.{number}{path.suffix}")).exists():
        number += 1
    logger.warning("%s belongs to an earlier run and is kept as %s.", path, other.name)
    os.replace(path, other)


class RunningMean:
    """Means of named values, summed where the values are.

    The tensors of one push are stacked and added to the sums of their names: two kernels a push however many names.
    """

    def __init__(self) -> None:
        self._tensors: dict[tuple[torch.device, tuple[str, ...]], tuple[Tensor, int]] = {}
        self._floats: dict[str, tuple[float, int]] = {}

    def push(self, metrics: Mapping[str, Tensor | float]) -> None:
        """Add values to the averages; tensors stay on their device."""
        by_device: dict[torch.device, dict[str, Tensor]] = defaultdict(dict)
        for name, value in metrics.items():
            if isinstance(value, Tensor):
                by_device[value.device][name] = value.detach().float().mean() if value.ndim else value.detach().float()
            else:
                total, count = self._floats.get(name, (0.0, 0))
                self._floats[name] = (total + float(value), count + 1)
        for device, values in by_device.items():
            key = (device, tuple(values))
            stacked = torch.stack(list(values.values()))
            sums, pushes = self._tensors.get(key, (torch.zeros_like(stacked), 0))
            self._tensors[key] = (sums + stacked, pushes + 1)

    def pop(self) -> dict[str, float]:
        """Returns the means by name, in order of first appearance, and starts anew. Copies once from each device."""
        totals: dict[str, tuple[float, int]] = dict(self._floats)
        for device in {device for device, _ in self._tensors}:
            groups = [(names, *entry) for (where, names), entry in self._tensors.items() if where == device]
            numbers = iter(torch.cat([total for _, total, _ in groups]).tolist())
            for names, _, count in groups:
                for name in names:
                    total, before = totals.get(name, (0.0, 0))
                    totals[name] = (total + next(numbers), before + count)
        self._tensors.clear()
        self._floats.clear()
        return {name: total / count for name, (total, count) in totals.items()}


class EpisodeTracker:
    """Finds the finished episodes in a collector's rollouts, carrying unfinished ones from rollout to rollout.

    Args:
        num_envs: N.
        crash_causes: names of the values of ``("next", "race", "crash")``, 0 meaning no crash.

    Example:
        >>> tracker = EpisodeTracker(num_envs=16)
        >>> # for rollout in collector:
        >>> #     episodes = tracker.update(rollout)
        >>> #     metrics.push(tracker.summary(episodes))
    """

    _FACTS = ("gates_passed", "crash", "finished")

    def __init__(self, num_envs: int, crash_causes: type[IntEnum] | None = None) -> None:
        self.crash_causes = crash_causes
        self._return = torch.zeros(num_envs, dtype=torch.float64)  # (N,) of the unfinished episodes
        self._length = torch.zeros(num_envs, dtype=torch.int64)  # (N,)

    def update(self, rollout: TensorDictBase) -> TensorDictBase:
        """Accounts for one rollout.

        Args:
            rollout: batch ``[N, T]`` with ``("next", "reward")``, ``("next", "done")`` and, if there are any,
                ``("next", "truncated")``, ``("next", "race", ...)`` and the root's ``is_init``.

        Returns:
            Finished episodes, batch ``[E]``, on the CPU, in the order in which they ended: ``env`` int64, ``return``
            float32 (undiscounted), ``length`` int64 (control steps), and as they were at the episode's last step
            ``truncated``, ``gates_passed``, ``crash`` and ``finished``, as far as the rollout has them, all ``(E,)``.
        """
        reward = rollout["next", "reward"].squeeze(-1).cpu().double()  # (N, T)
        done = rollout["next", "done"].squeeze(-1).cpu()
        self._forget_interrupted(rollout)
        # Sums since the unfinished episode began, or since the rollout's first step after that.
        returned = self._return.unsqueeze(-1) + reward.cumsum(-1)  # (N, T)
        lasted = self._length.unsqueeze(-1) + torch.arange(1, done.shape[-1] + 1)
        env, step = done.nonzero(as_tuple=True)  # (E,) environment by environment
        previous = torch.arange(len(env)) - 1
        continues = torch.zeros_like(env, dtype=torch.bool)  # an earlier episode of this environment ended here too
        continues[1:] = env[1:] == env[:-1]
        returns, lengths = (
            values[env, step] - torch.where(continues, values[env, step][previous], 0) for values in (returned, lasted)
        )
        self._carry(returned, lasted, env, step)
        order = torch.argsort(step, stable=True)
        episodes = {"env": env, "return": returns.float(), "length": lengths, **self._facts(rollout, env, step)}
        return TensorDict(episodes, batch_size=[len(env)])[order]

    def summary(self, episodes: TensorDictBase) -> dict[str, float]:
        """Returns the metrics of finished episodes: means, and for each crash cause the share that ended by it.

        Args:
            episodes: batch ``[E]`` of `update`.

        Returns:
            ``episode/return``, ``episode/length``, ``episode/gates_passed``, ``crash/<cause>``; empty if E = 0.
        """
        if not len(episodes):
            return {}
        names = [name for name in ("return", "length", "gates_passed") if name in episodes]
        metrics = {f"episode/{name}": episodes[name].double().mean().item() for name in names}
        for cause in self.crash_causes or ():
            if cause and "crash" in episodes:
                metrics[f"crash/{cause.name.lower()}"] = (episodes["crash"] == cause).double().mean().item()
        return metrics

    def state_dict(self) -> dict[str, Any]:
        """Return everything that a checkpoint needs."""
        return {"return": self._return.clone(), "length": self._length.clone()}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        self._return = state_dict["return"].clone()
        self._length = state_dict["length"].clone()

    def _forget_interrupted(self, rollout: TensorDictBase) -> None:
        """Drops the unfinished episodes of environments that were reset meanwhile, as they are when a run resumes."""
        is_init = rollout.get("is_init", None)
        if is_init is not None:
            began = is_init[:, 0].reshape(-1).cpu()
            self._return[began] = 0
            self._length[began] = 0

    def _carry(self, returned: Tensor, lasted: Tensor, env: Tensor, step: Tensor) -> None:
        """Keeps what came after each environment's last episode end."""
        last = torch.full((len(returned),), -1).scatter_reduce(0, env, step, "amax")  # (N,) −1: none ended
        at = last.clamp(min=0).unsqueeze(-1)
        self._return, self._length = (
            values[:, -1] - torch.where(last >= 0, values.gather(-1, at).squeeze(-1), 0)
            for values in (returned, lasted)
        )

    def _facts(self, rollout: TensorDictBase, env: Tensor, step: Tensor) -> dict[str, Tensor]:
        found = {name: rollout["next"].get(("race", name), None) for name in self._FACTS}
        found["truncated"] = rollout["next"].get("truncated", None)
        return {name: value.squeeze(-1).cpu()[env, step] for name, value in found.items() if value is not None}
