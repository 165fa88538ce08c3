"""What a person sees in a terminal: progress bars and tables."""

import concurrent.futures
import math
import multiprocessing
import queue
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from codrl_mj.evaluation import Evaluation
from codrl_mj.training import TrainConfig, train
from codrl_mj.validation import Check


def console() -> Console:
    """A console on standard output; 110 columns where it goes to a file, which has no width of its own."""
    return Console() if sys.stdout.isatty() else Console(width=110)


def progress_bar(*columns: str) -> Progress:
    """A progress display with the given text columns, the time elapsed and the time left."""
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        *(TextColumn(column) for column in columns),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        console=console(),
    )


def train_with_bars(runs: Mapping[str, tuple[TrainConfig, Path]]) -> None:
    """Train, showing a bar for each run; several runs go side by side in processes of their own.

    Args:
        runs: description -> (configuration, run folder to make).

    Raises:
        Exception: whatever `codrl_mj.training.train` raises, in the first run that fails.
    """
    columns = "{task.completed:,}/{task.total:,} steps", "return {task.fields[back]:.0f}", "{task.fields[speed]:.0f}/s"
    with progress_bar(*columns) as bar:
        rows = {
            name: bar.add_task(name, total=config.total_steps, back=math.nan, speed=math.nan)
            for name, (config, _) in runs.items()
        }

        def show(name: str, progress: Any) -> None:
            bar.update(
                rows[name],
                completed=min(progress.steps, progress.total_steps),
                back=progress.mean_return,
                speed=progress.steps_per_second,
            )

        if len(runs) == 1:
            ((name, (config, out)),) = runs.items()
            train(config, out, lambda progress: show(name, progress))
        else:
            _train_side_by_side(runs, show)


def _train_side_by_side(runs: Mapping[str, tuple[TrainConfig, Path]], show: Callable[[str, Any], None]) -> None:
    context = multiprocessing.get_context("spawn")
    with (
        context.Manager() as manager,
        concurrent.futures.ProcessPoolExecutor(len(runs), mp_context=context) as pool,
    ):
        reports = manager.Queue()
        futures = [pool.submit(_train_reporting, name, config, out, reports) for name, (config, out) in runs.items()]
        while not all(future.done() for future in futures):
            try:
                show(*reports.get(timeout=0.2))
            except queue.Empty:
                continue
        while not reports.empty():
            show(*reports.get())
        for future in futures:
            future.result()


def _train_reporting(name: str, config: TrainConfig, out: Path, reports: Any) -> None:
    train(config, out, lambda progress: reports.put((name, progress)))


def print_evaluations(evaluations: Mapping[str, Evaluation]) -> None:
    """Print one table, a row for each evaluation by its name."""
    count = next(iter(evaluations.values())).episodes
    table = Table(title=f"{count} episodes a row: mean [95 % bootstrap interval]")
    table.add_column("policy", no_wrap=True)
    for column in ("return", "torque error", "of desired", "max |u|", "saturated"):
        table.add_column(column, justify="right")
    for name, result in evaluations.items():
        table.add_row(
            name,
            "{:.1f} [{:.1f}, {:.1f}]".format(*result.returns),
            f"{result.tracking_rms:.3f} N·m",
            f"{result.tracking_percent:.0f} %",
            "–" if result.peak_voltage is None else f"{result.peak_voltage:.1f} V",
            f"{result.saturated_percent:.1f} %",
        )
    console().print(table)


def print_checks(checks: Sequence[Check]) -> None:
    """Print one table, a row for each check."""
    table = Table(title="MuJoCo against Gymnasium")
    for column in ("check", "steps", "worst error", "allowed", "verdict"):
        table.add_column(column, justify="right" if column in ("steps", "worst error", "allowed") else "left")
    for check in checks:
        verdict = "[green]passed" if check.passed else f"[red]FAILED at {check.where}"
        table.add_row(check.name, f"{check.samples:,}", f"{check.worst:.1e}", f"{check.tolerance:.0e}", verdict)
    console().print(table)
