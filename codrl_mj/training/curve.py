"""The learning curve of a run as a picture."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from codrl_mj.runs.files import writing
from codrl_mj.training.config import TrainConfig
from codrl_mj.training.history import REPORT_COLUMNS, WINDOW


def draw_learning_curve(path: Path, config: TrainConfig, episodes: np.ndarray, reports: np.ndarray) -> None:
    """Draw the returns of the training episodes, their running mean, and the evaluations.

    Args:
        path: PNG file.
        config: of the run.
        episodes: rows of `EPISODE_COLUMNS`.
        reports: rows of `REPORT_COLUMNS`.
    """
    figure = Figure(figsize=(6, 3.5), layout="constrained")
    axes = figure.subplots()
    steps, returns = episodes[:, 1], episodes[:, 2]
    axes.plot(steps, returns, ".", markersize=2, color="0.7", rasterized=True, label="training episodes")
    if len(returns):
        sums = np.cumsum(np.concatenate([[0.0], returns]))
        ends = np.arange(1, len(returns) + 1)
        starts = np.maximum(0, ends - WINDOW)
        axes.plot(steps, (sums[ends] - sums[starts]) / (ends - starts), color="C0", label=f"mean of {WINDOW}")
    column = {name: reports[:, index] for index, name in enumerate(REPORT_COLUMNS)}
    evaluated = np.isfinite(column["evaluation_return"])
    evaluations = column["steps"][evaluated], column["evaluation_return"][evaluated]
    axes.plot(*evaluations, "o-", color="C1", markersize=3, label="evaluations")
    axes.set(xlabel="environment steps", ylabel="return", title=f"{config.agent.name.upper()} on {config.task}")
    axes.grid(alpha=0.3)
    axes.legend(loc="lower right", fontsize="small")
    with writing(path) as temporary:
        figure.savefig(temporary, dpi=150)
