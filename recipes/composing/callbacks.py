"""Draw the figures of an experiment at its end, in a callback that hydra calls after a multirun."""

import shutil
from pathlib import Path
from typing import Any

from hydra.experimental.callback import Callback
from omegaconf import DictConfig

FAILURES = "failures"  # folder of an experiment: a file for every run that failed
DRAWN = ("return", "success_rate", "gates", "lap_time")


class DrawFigures(Callback):
    """Draws the figures of `recipes/plot.py` into `figures/` of the experiment, even if a run has failed."""

    def __init__(self, axis: str = "env_steps") -> None:
        self._axis = axis

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Delete the notes on failed runs of an earlier multirun."""
        shutil.rmtree(Path(config.hydra.sweep.dir) / FAILURES, ignore_errors=True)

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        """Draw all figures for which there is data; exit with status 1 if a run has failed."""
        # Imported here, because hydra makes this object at the start of every job, and only the end draws.
        from dreamer_racing.figures.plotting import PlotConfig, draw
        from dreamer_racing.terminal import start_logging

        start_logging()
        place = Path(config.hydra.sweep.dir)
        print(f"figures: {place}/figures")
        try:
            draw(PlotConfig(str(place), output=f"{place}/figures", quantities=list(DRAWN), axis=self._axis))
        except (ValueError, OSError) as error:
            print(f"figures: none, {error}")
        finally:  # hydra turns all other errors into warnings
            notes = sorted((place / FAILURES).glob("*.txt"))
            for note in notes:
                print(f"failed: {note.stem}: {note.read_text(encoding='utf-8').strip()}")
            if notes:
                raise SystemExit(1)
