"""What is made of an experiment at its end: hydra calls this after a multirun."""

from typing import Any

from hydra.experimental.callback import Callback
from omegaconf import DictConfig

QUANTITIES = ("return", "success_rate", "gates", "lap_time")


class DrawFigures(Callback):
    """Draws what `recipes/plot.py` draws, into `figures/` of the experiment, also when a run of it has failed."""

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        """Draw everything for which there is something to draw."""
        from plot import draw
        from schema import PlotConfig

        place = config.hydra.sweep.dir
        print(f"figures: {place}/figures")
        draw(PlotConfig(runs=place, output=f"{place}/figures", quantities=list(QUANTITIES)))
