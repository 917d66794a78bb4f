"""What is made of an experiment at its end: hydra calls this after a multirun."""

import shutil
from pathlib import Path
from typing import Any

from hydra.experimental.callback import Callback
from omegaconf import DictConfig

FAILURES = "failures"  # folder of an experiment: a file for every run that failed
DRAWN = ("return", "success_rate", "gates", "lap_time")


class DrawFigures(Callback):
    """Draws what `recipes/plot.py` draws, into `figures/` of the experiment, also when a run of it has failed.

    Args:
        axis: of curves and comparison, as of `recipes/plot.py`.
    """

    def __init__(self, axis: str = "env_steps") -> None:
        self._axis = axis

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Forget what failed in an earlier multirun: what fails again says so again."""
        shutil.rmtree(Path(config.hydra.sweep.dir) / FAILURES, ignore_errors=True)

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        """Draw everything for which there is something to draw; end with status 1 if a run has failed."""
        # Here, because hydra makes this object at the start of every job, and drawing is for the end.
        from composing.entry import start_logging
        from dreamer_racing.figures.plotting import PlotConfig, draw

        start_logging()

        place = Path(config.hydra.sweep.dir)
        print(f"figures: {place}/figures")
        try:
            draw(PlotConfig(str(place), output=f"{place}/figures", quantities=list(DRAWN), axis=self._axis))
        except (ValueError, OSError) as error:
            print(f"figures: none, {error}")
        finally:  # of all other errors hydra makes a warning
            notes = sorted((place / FAILURES).glob("*.txt"))
            for note in notes:
                print(f"failed: {note.stem}: {note.read_text(encoding='utf-8').strip()}")
            if notes:
                raise SystemExit(1)
