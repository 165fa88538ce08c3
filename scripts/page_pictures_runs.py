"""Pictures of the pages on logs, runs and checks, drawn from commands and published tables.

`PICTURES` has a function for each, by its name in docs/pictures. Example: python
scripts/page_pictures_runs.py disturbances.svg; all of them take some minutes. Chromium takes
screenshots of HTML pages.
"""

import argparse
import csv
import functools
import os
import runpy
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import gymnasium
import matplotlib
import numpy as np
from matplotlib import pyplot
from PIL import Image

import codrl_mj
from codrl_mj.cli import main as command

DOCS = Path(__file__).parents[1] / "docs"
BLUE, ORANGE, RED, GREY = "#0b62b8", "#bd5a0e", "#a8134a", "#5b6672"
NAMES = ("chromium", "chromium-browser", "google-chrome")
CHROMIUM = (
    "--no-sandbox",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-sync",
)
COLUMNS = "time=time:s,voltage=mean(voltage):V,current=current:A,position=position:rad"
BENCH = """name: maxon-ec45-flat-50w
motor: {gear_ratio: 20.0, resistance: 1.13, torque_constant: 0.0311, back_emf_constant: 0.0311,
        coulomb_friction: 0.0155, viscous_friction: 1.0e-4}
"""
"""Motor on the bench of docs/tutorial_log_to_policy.md."""


def run(*words: str) -> None:
    """Run a codrl-mj command; exit if it fails."""
    if command(list(words)) != 0:
        raise SystemExit(f"codrl-mj {' '.join(words)} failed")


@contextmanager
def drawing(width: float, height: float, **options: Any) -> Iterator[tuple[Any, Any]]:
    """Create a figure of the given size [in] and its axes, and close it afterwards."""
    # A fixed salt makes the ids in an SVG, and hence the file, the same every time.
    style = {
        "svg.hashsalt": "codrl_mj",
        "font.size": 9,
        "axes.spines.top": False,
        "axes.spines.right": False,
    }
    with matplotlib.rc_context(
        {**style, "axes.axisbelow": True, "axes.grid": True, "grid.color": "#e3e6ea"}
    ):
        figure, axes = pyplot.subplots(figsize=(width, height), layout="constrained", **options)
        yield figure, axes
        pyplot.close(figure)


def save(figure: Any, path: Path) -> None:
    """Write a figure without its date, so that the file is the same every time."""
    figure.savefig(path, metadata={"Date": None} if path.suffix == ".svg" else None)


def shot(
    page: Path, selector: str, path: Path, width: int = 1100, height: int | None = None
) -> None:
    """Take a screenshot of a page's element with Chromium, cut at a height."""
    from playwright.sync_api import sync_playwright

    browser_path = os.environ.get("CHROMIUM") or next(filter(None, map(shutil.which, NAMES)), None)
    if browser_path is None:
        raise SystemExit("Chromium is not installed: apt-get install chromium")
    with sync_playwright() as playwright, tempfile.TemporaryDirectory() as temporary:
        browser = playwright.chromium.launch(executable_path=browser_path, args=list(CHROMIUM))
        tab = browser.new_page(viewport={"width": width, "height": 900}, color_scheme="light")
        tab.emulate_media(reduced_motion="reduce")
        tab.goto(page.resolve().as_uri())
        # The element says how long the check took, which differs from run to run.
        tab.evaluate("document.querySelectorAll('details').forEach(one => one.remove())")
        picture = Path(temporary) / "shot.png"
        tab.locator(selector).first.screenshot(path=picture, timeout=300_000)
        browser.close()
        with Image.open(picture) as image:
            cropped = image.convert("RGB").crop(
                (0, 0, image.width, min(height or image.height, image.height))
            )
            cropped.quantize(128).save(path, optimize=True)


def identified(path: Path) -> None:
    """Draw the share of draws that identify each parameter under each excitation.

    The numbers are from the table of docs/identify_measured.md.
    """
    with (DOCS / "identify_measured.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    logs = list(
        dict.fromkeys(
            (row["excitation"], row["rows have"], row["rows a second [Hz]"]) for row in rows
        )
    )
    parameters = list(dict.fromkeys(row["number"] for row in rows))
    shares = np.full((len(logs), len(parameters)), np.nan)
    with drawing(8.6, 4.6) as (figure, axes):
        for row in rows:
            y = logs.index((row["excitation"], row["rows have"], row["rows a second [Hz]"]))
            x, share = parameters.index(row["number"]), int(row["identified"]) / int(row["draws"])
            shares[y, x] = share
            error = f"\n{row['largest error [%]']} %" if row["largest error [%]"] else ""
            axes.text(
                x,
                y,
                f"{share:.0%}{error}",
                ha="center",
                va="center",
                fontsize=6.5,
                linespacing=0.95,
            )
        axes.imshow(shares, cmap="Blues", vmin=0.0, vmax=1.9, aspect="auto")
        axes.set_xticks(range(len(parameters)), parameters)
        names = [
            f"{kind}, {int(rate) // 1000} kHz, {row_content}" for kind, row_content, rate in logs
        ]
        axes.set_yticks(range(len(logs)), names, fontsize=7.5)
        axes.xaxis.tick_top()
        axes.grid(visible=False)
        axes.tick_params(length=0)
        axes.set_xlabel("share of draws that identify it, and their largest error")
        save(figure, path)


def worked(path: Path) -> None:
    """Draw the returns of the worked examples, by training and test actuator."""
    with (DOCS / "worked_examples.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    through, colors = ("ideal", "chosen", "smaller"), (BLUE, ORANGE, RED)
    with drawing(8.6, 2.9, ncols=3) as (figure, axes):
        for panel, name in zip(
            axes, dict.fromkeys(row["environment"] for row in rows), strict=True
        ):
            for color_index, (trained, color) in enumerate(zip(through, colors, strict=True)):
                for tested_index, tested in enumerate(through):
                    key = (name, trained, tested)
                    columns = ("environment", "trained through", "tested on")
                    returns = [
                        float(row["return"])
                        for row in rows
                        if tuple(row[column] for column in columns) == key
                    ]
                    x = tested_index + 0.22 * (color_index - 1)
                    panel.plot(
                        [x, x], [min(returns), max(returns)], color=color, linewidth=1.2, alpha=0.5
                    )
                    panel.plot(
                        [x] * len(returns), returns, "o", color=color, markersize=2.5, alpha=0.5
                    )
                    label = f"trained through {trained}" if tested_index == 0 else None
                    panel.plot(
                        x,
                        np.mean(returns),
                        "_",
                        color=color,
                        markersize=11,
                        markeredgewidth=2.5,
                        label=label,
                    )
            panel.set_title(name, loc="left", fontweight="bold", fontsize=9)
            panel.set_xticks(range(3), [f"on {tested}" for tested in through])
            panel.grid(visible=False, axis="x")
        axes[0].set_ylabel("return of three seeds, mean")
        figure.legend(
            *axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False
        )
        save(figure, path)


def trained_elsewhere(path: Path) -> None:
    """Draw the learning curves of docs/train_elsewhere.md."""
    results = runpy.run_path(str(DOCS.parent / "examples" / "train_elsewhere" / "results.py"))
    rows = results["read_rows"](DOCS / "train_elsewhere_curves.csv")
    results["draw_learning_curves"](rows, path)


def disturbed(path: Path) -> None:
    """Draw the effect of each disturbance of commands, and of load pulses, on an ideal Pendulum."""
    kinds = {
        "command_delay = 0.1 s": {"command_delay": 0.1},
        "command_quantum = 0.5 N·m": {"command_quantum": 0.5},
        "command_rate = 8 N·m/s": {"command_rate": 8.0},
        "load pulses": {"pulse_force": 1.0, "pulse_duration": 0.15, "pulse_interval": 0.5},
    }
    step, steps = 0.05, 48
    desired = (
        1.6
        * np.sin(2.0 * np.pi * np.arange(steps) / 24.0)
        * np.sign(np.sin(2.0 * np.pi * np.arange(steps) / 32.0))
    )
    time = step * np.arange(steps + 1)
    with drawing(8.6, 2.2, ncols=4, sharey=True) as (figure, axes):
        for panel, (name, fields) in zip(axes, kinds.items(), strict=True):
            env = gymnasium.make("codrl_mj/Pendulum-v0", actuator="ideal", disturbances=fields)
            physics: Any = env.get_wrapper_attr("physics")
            env.reset(seed=3)
            delivered, pushed = [], []
            for force in desired:
                info = env.step(np.array([force], np.float32))[4]
                delivered.append(float(info["actual_force"]))
                pushed.append(float(physics.data.qfrc_applied[0]))
            env.close()
            panel.stairs(
                desired,
                time,
                color=BLUE,
                linewidth=1.0,
                linestyle="--",
                baseline=None,
                label="desired",
            )
            panel.stairs(
                delivered, time, color=ORANGE, linewidth=1.4, baseline=None, label="delivered"
            )
            if "pulse_force" in fields:
                panel.stairs(pushed, time, color=RED, fill=True, alpha=0.35, label="load pulses")
            panel.set_title(name, loc="left", fontsize=7.5, fontweight="bold")
            panel.set_xlabel("time [s]")
        axes[0].set_ylabel("torque [N·m]")
        handles = dict(zip(*reversed(axes[3].get_legend_handles_labels()), strict=True))
        figure.legend(
            handles.values(), handles.keys(), loc="outside lower center", ncols=3, frameon=False
        )
        save(figure, path)


def drawn(path: Path) -> None:
    """Draw the step responses of thirty random motors of CartPole."""
    fields = {
        "motor.inductance": codrl_mj.Uniform(0.05, 0.2),
        "controller.kp": codrl_mj.LogUniform(0.5, 5.0),
    }
    gains, responses = [], []
    env = gymnasium.make("codrl_mj/CartPole-v0", randomize=fields, inner_steps=20)
    for seed in range(30):
        info = env.reset(seed=seed)[1]
        gains.append(float(info["randomization"]["controller.kp"]))
        responses.append([0.0])
        for _ in range(16):
            responses[-1].append(float(env.step(1)[4]["actual_force"]))
    env.close()
    color = matplotlib.colormaps["viridis"]
    scale = matplotlib.colors.LogNorm(0.5, 5.0)
    with drawing(6.2, 2.6) as (figure, axes):
        for gain, response in zip(gains, responses, strict=True):
            axes.plot(
                0.02 * np.arange(len(response)), response, color=color(scale(gain)), linewidth=0.9
            )
        axes.axhline(10.0, color=GREY, linestyle="--", linewidth=1.0)
        axes.set_xlabel("time [s]")
        axes.set_ylabel("delivered force [N]")
        shown = matplotlib.cm.ScalarMappable(scale, color)
        figure.colorbar(
            shown, ax=axes, label="kp [V/A]", ticks=[0.5, 1, 2, 5], format="%g"
        ).minorticks_off()
        save(figure, path)


def fitted(path: Path) -> None:
    """Draw the held-out log of the tutorial, predicted by the fit to the two others."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        bench, logs = folder / "real.yaml", [str(folder / f"swing{seed}.csv") for seed in (1, 2, 3)]
        bench.write_text(BENCH)
        voltage = (
            "--kind",
            "prbs",
            "--amplitude",
            "20",
            "--clock",
            "0.002",
            "--mean-voltage",
            "--duration",
            "4",
        )
        sensors = ("--sensor", "current:noise=0.05", "position:resolution=0.001534")
        for seed, log in enumerate(logs, start=1):
            run(
                "identify",
                "simulate",
                str(bench),
                *voltage,
                *sensors,
                "--seed",
                str(seed),
                "--out",
                log,
            )
        known = (
            "--rig",
            "free",
            "--known",
            "gear_ratio=20",
            "load_inertia=0",
            "--motor",
            "maxon-ec45-flat-50w",
        )
        words = (
            *logs[:2],
            "--holdout",
            logs[2],
            "--columns",
            COLUMNS,
            *known,
            "--out",
            str(folder / "motor"),
        )
        run("identify", *words)
        shot(folder / "motor" / "report.html", "#held-out", path, height=392)


def planned(path: Path) -> None:
    """Draw the voltage of docs/identify_logs.md's plan, and the response of a simulated bench."""
    motor = "maxon-ec45-flat-50w"
    load = ("--inertia", "1e-4")
    names = ("voltage", "current", "velocity")
    with tempfile.TemporaryDirectory() as temporary:
        log = Path(temporary) / "log.csv"
        words = ("--kind", "prbs", "--amplitude", "5.1", "--clock", "0.002", "--rate", "1000")
        run(
            "identify",
            "simulate",
            motor,
            *load,
            *words,
            "--sensor",
            "current:noise=0.02",
            "--out",
            str(log),
        )
        rows = np.genfromtxt(log, delimiter=",", names=True)
    rows = rows[rows["time"] <= 2.0]
    with drawing(7.0, 3.6, nrows=3, sharex=True) as (figure, axes):
        for panel, name, unit, color in zip(
            axes, names, ("V", "A", "rad/s"), (BLUE, ORANGE, RED), strict=True
        ):
            panel.step(rows["time"], rows[name], color, linewidth=0.6, where="post")
            panel.set_ylabel(f"{name} [{unit}]")
        axes[-1].set_xlabel("time [s]")
        save(figure, path)


@functools.cache
def certificate() -> "tempfile.TemporaryDirectory[str]":
    """Write the certificate of all tasks to a folder that is deleted at exit."""
    temporary = tempfile.TemporaryDirectory()
    run("validate", "--out", temporary.name)
    return temporary


def certified(path: Path) -> None:
    """Draw the top of the certificate, with its first checks."""
    shot(Path(certificate().name) / "certificate.html", "body", path, height=660)


def converged(path: Path) -> None:
    """Draw a plot of the certificate: errors over the electrical substep."""
    shot(Path(certificate().name) / "certificate.html", "#motor figure", path)


def trained(folder: Path) -> Path:
    """Train the run of docs/training.md; return its folder."""
    run(
        "train",
        "cartpole",
        "--actuator",
        "weaker",
        "--env.center-radius",
        "0.1",
        "--out",
        str(folder / "mine"),
    )
    return folder / "mine"


def learned(path: Path) -> None:
    """Draw the learning curve of that run."""
    with (
        tempfile.TemporaryDirectory() as temporary,
        Image.open(trained(Path(temporary)) / "learning_curve.png") as image,
    ):
        image.convert("RGB").quantize(64).save(path, optimize=True)


def filmed(path: Path) -> None:
    """Write the last frame of a film of that run: CartPole, balanced through a weak loop."""
    with tempfile.TemporaryDirectory() as temporary:
        frames = Path(temporary) / "film"
        size = ("--width", "480", "--height", "320", "--env.max-episode-steps", "120")
        run("render", str(trained(Path(temporary))), "--out", str(frames), *size)
        with Image.open(max(frames.iterdir())) as image:
            image.convert("RGB").quantize(128).save(path, optimize=True)


PICTURES: Mapping[str, Callable[[Path], None]] = {
    "identify_measured.svg": identified,
    "worked_examples.svg": worked,
    "train_elsewhere.png": trained_elsewhere,
    "disturbances.svg": disturbed,
    "randomization.svg": drawn,
    "tutorial_fit.png": fitted,
    "plan.png": planned,
    "certificate.png": certified,
    "convergence.png": converged,
    "learning_curve.png": learned,
    "film.png": filmed,
}
"""Name in docs/pictures -> function that writes it."""

if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "names", nargs="*", choices=PICTURES, default=list(PICTURES), help="pictures to make"
    )
    for name in parser.parse_args().names:
        PICTURES[name](DOCS / "pictures" / name)
        print(f"wrote docs/pictures/{name}")
