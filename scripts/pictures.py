"""Make pictures of what comes out, for the README, the gallery and the pages; some are of pages, which takes Chromium.

`PICTURES` has what makes each, by its name in docs/pictures, or by its path in docs where it has a
folder. Those of the pages are in page_pictures_*.py beside this file. Example: python
scripts/pictures.py motor.png log.png; or all, in half an hour.
"""

import argparse
import importlib
import math
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from PIL import Image

import codrl_mj
from codrl_mj.cli import main as command
from codrl_mj.runs.files import atomic_write
from codrl_mj.tasks import TASKS
from codrl_mj.viz.films.strip import draw_text

DOCS = Path(__file__).parents[1] / "docs"
COLUMNS = "time=time:s,voltage=voltage:V,current=current:A,position=position:rad"
CHROMIUM = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--hide-scrollbars",
    "--window-size=1280,860",
)
CHROMIUM_OFFLINE = (
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)
ROBOTS = {
    "HalfCheetah-v5": "maxon-ec45-flat-50w",
    "Ant-v5": "cubemars-ak80-6",
    "Humanoid-v5": "lag",
    "Hopper-v5": "torque_speed",
}
"""Somebody's environment -> what its motors are in the gallery."""
POSES = {
    "pendulum": (2.3, 0.0),
    "cartpole": (-0.8, 0.0, 0.15, 0.0),
    "acrobot": (1.9, 0.7, 0.0, 0.0),
    "mountain_car": (0.3, 0.0),
    "mountain_car_continuous": (-0.9, 0.0),
    "furuta": (0.6, 2.6, 0.0, 0.0),
}
"""Task -> a state that shows what it is."""


def run(*words: str) -> None:
    """A command of ours, which has to succeed."""
    if command(list(words)) != 0:
        raise SystemExit(f"codrl-mj {' '.join(words)} failed")


def smaller(picture: Image.Image | Path, out: Path, width: int = 960) -> None:
    """Write a picture with a palette of 128 colours."""
    image = Image.open(picture) if isinstance(picture, Path) else picture
    size = width, round(image.height * width / image.width)
    with atomic_write(out) as temporary:
        small = image.convert("RGB").resize(size, Image.Resampling.LANCZOS).quantize(128)
        small.save(temporary, "PNG", optimize=True)


def photographed(page: Path, out: Path, folder: Path) -> None:
    """Write what Chromium shows of a page."""
    chromium = (
        shutil.which("chromium")
        or shutil.which("chromium-browser")
        or shutil.which("google-chrome")
    )
    if chromium is None:
        raise SystemExit("Chromium is not installed: apt-get install chromium")
    shot, profile = folder / "shot.png", f"--user-data-dir={folder / 'profile'}"
    subprocess.run(
        [chromium, *CHROMIUM, *CHROMIUM_OFFLINE, profile, f"--screenshot={shot}", page.as_uri()],
        check=True,
    )
    smaller(shot, out)


def motor(out: Path) -> None:
    """A motor under a task."""
    with tempfile.TemporaryDirectory() as made:
        run(
            "motor",
            "feasible",
            "maxon-ec45-flat-50w",
            "pendulum",
            "--gear-ratio",
            "20",
            "--out",
            made,
        )
        smaller(Path(made) / "torque_speed.png", out)


def log(out: Path) -> None:
    """The report of an identification."""
    with tempfile.TemporaryDirectory() as made:
        logs = [str(Path(made) / f"swing{seed}.csv") for seed in (1, 2)]
        for seed, one in enumerate(logs, start=1):
            words = [
                "--kind",
                "prbs",
                "--amplitude",
                "8",
                "--rate",
                "5000",
                "--sensor",
                "current:noise=0.05",
            ]
            run(
                "identify",
                "simulate",
                "maxon-ec45-flat-50w",
                "--out",
                one,
                "--seed",
                str(seed),
                *words,
            )
        words = ["--columns", COLUMNS, "--rig", "free", "--known", "load_inertia=0"]
        run("identify", *logs, *words, "--out", str(Path(made) / "found"))
        photographed(Path(made) / "found" / "report.html", out, Path(made))


def sheet(frames: Mapping[str, np.ndarray], columns: int) -> Image.Image:
    """Frames of one size side by side, each above its name."""
    width = next(iter(frames.values())).shape[1]
    cells = [
        np.vstack([frame, draw_text(name, width, 40)[..., :3]]) for name, frame in frames.items()
    ]
    cells += [np.full_like(cells[0], 255)] * (-len(cells) % columns)
    rows = [np.hstack(cells[at : at + columns]) for at in range(0, len(cells), columns)]
    return Image.fromarray(np.vstack(rows))


def tasks(out: Path) -> None:
    """The six tasks."""
    frames = {}
    for name in TASKS:
        env = codrl_mj.make(name, render_mode="rgb_array", width=480, height=360, pretty=True)
        env.reset(seed=0)
        env.unwrapped.state = np.array(POSES[name])  # type: ignore[attr-defined]
        frames[name] = env.render()
        env.close()
    smaller(sheet(frames, 3), out)


def robots(out: Path) -> None:
    """Environments of others with motors in them, a second into an episode of random actions."""
    frames = {}
    for name, actuator in ROBOTS.items():
        env = codrl_mj.make(name, actuator, render_mode="rgb_array", width=480, height=360)
        env.action_space.seed(0)
        env.reset(seed=0)
        for _ in range(math.ceil(0.4 / env.unwrapped.dt)):  # type: ignore[attr-defined]
            env.step(env.action_space.sample())
        frames[f"{name} on {actuator}"] = env.render()
        env.close()
    smaller(sheet(frames, 2), out)


OTHERS = "page_pictures_motors", "page_pictures_runs", "page_pictures_tasks"


def pictures() -> dict[str, Callable[[Path], None]]:
    """All of them."""
    found: dict[str, Callable[[Path], None]] = {
        "motor.png": motor,
        "log.png": log,
        "tasks.png": tasks,
        "robots.png": robots,
    }
    for name in OTHERS:
        if (Path(__file__).parent / f"{name}.py").is_file():
            found |= importlib.import_module(name).PICTURES
    return found


def main() -> None:
    """Make those that are named, or all."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    known = pictures()
    parser.add_argument(
        "names", nargs="*", choices=[*known, []], metavar="NAME", help=f"of {', '.join(known)}"
    )
    for name in parser.parse_args().names or known:
        known[name](DOCS / name if "/" in name else DOCS / "pictures" / name)
        print(f"wrote {name}", flush=True)


if __name__ == "__main__":
    main()
