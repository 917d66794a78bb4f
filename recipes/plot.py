"""Draw the paper's figures from what runs have stored: no simulator, no network, no GPU.

    python recipes/plot.py runs=runs/my_experiment
    python recipes/plot.py runs='runs/*_kidney_*' figure=learning_curves quantities=[return,success_rate] aggregate=iqm

Runs of one algorithm, track and variant become one curve if only their seeds differ; if other settings differ, too,
there is a curve for each combination, and the legend names them. Runs and files that cannot be read are left out, and
named in `<figure>_left_out.txt` beside the figure. With `figure=all` a figure that cannot be drawn is named, and the
others are still drawn. `learning_curves.csv` beside a figure holds its data, and `runs=learning_curves.csv` draws it
again.
"""

from composing.entry import plain_errors, recipe

from dreamer_racing.figures.plotting import PlotConfig, draw


@recipe("plot", PlotConfig)
def main(config: PlotConfig) -> None:
    """Draw the requested figures, and print what was left out."""
    with plain_errors():
        draw(config)


if __name__ == "__main__":
    main()
