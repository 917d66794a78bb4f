"""Draw the paper's figures from what runs have stored: no simulator, no network, no GPU.

    python recipes/plot.py runs=runs/my_experiment
    python recipes/plot.py runs='runs/*_kidney_*' figure=learning_curves quantities=[return,success_rate] aggregate=iqm

Runs of one algorithm, track and variant become one curve if they differ in their seeds alone; where other settings
differ, too, there is a curve for each way to set them, and the legend says which. Runs and files that cannot be read
are left out, and named in `<figure>_left_out.txt` beside the figure. With `figure=all` one that cannot be drawn is
named, and does not cost the others. `learning_curves.csv` beside a figure holds what it shows, and
`runs=learning_curves.csv` draws it again.
"""

from composing.entry import plain_errors, recipe

from dreamer_racing.figures.plotting import PlotConfig, draw


@recipe("plot", PlotConfig)
def main(config: PlotConfig) -> None:
    """Make the figures asked for, say what was left out."""
    with plain_errors():
        draw(config)


if __name__ == "__main__":
    main()
