"""Make pictures for the README, the gallery and the pages; screenshots of pages need Chromium.

`PICTURES` has a function for each, by its name in docs/pictures, or by its path in docs if it has a
folder. Other pages' pictures are in page_pictures_*.py beside this file. Example: python
scripts/pictures.py motor.png log.png; all of them take half an hour.
"""

import argparse
import importlib
import math
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

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
"""Third-party environment -> its motors in the gallery."""
POSES = {
    "pendulum": (2.3, 0.0),
    "cartpole": (-0.8, 0.0, 0.15, 0.0),
    "acrobot": (1.9, 0.7, 0.0, 0.0),
    "mountain_car": (0.3, 0.0),
    "mountain_car_continuous": (-0.9, 0.0),
    "furuta": (0.6, 2.6, 0.0, 0.0),
}
"""Task -> state in which its picture is taken."""


def run(*words: str) -> None:
    """Run a codrl-mj command; exit if it fails."""
    if command(list(words)) != 0:
        raise SystemExit(f"codrl-mj {' '.join(words)} failed")


def smaller(picture: Image.Image | Path, out: Path, width: int = 960) -> None:
    """Write a picture with a palette of 128 colors."""
    image = Image.open(picture) if isinstance(picture, Path) else picture
    size = width, round(image.height * width / image.width)
    with atomic_write(out) as temporary:
        small = image.convert("RGB").resize(size, Image.Resampling.LANCZOS).quantize(128)
        small.save(temporary, "PNG", optimize=True)


def take_screenshot(page: Path, out: Path, folder: Path) -> None:
    """Write a screenshot of a page, taken by Chromium."""
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
    """Draw a motor's limits and a task's demands."""
    with tempfile.TemporaryDirectory() as folder:
        run(
            "motor",
            "feasible",
            "maxon-ec45-flat-50w",
            "pendulum",
            "--gear-ratio",
            "20",
            "--out",
            folder,
        )
        smaller(Path(folder) / "torque_speed.png", out)


def log(out: Path) -> None:
    """Draw the report of an identification."""
    with tempfile.TemporaryDirectory() as folder:
        logs = [str(Path(folder) / f"swing{seed}.csv") for seed in (1, 2)]
        for seed, log_path in enumerate(logs, start=1):
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
                log_path,
                "--seed",
                str(seed),
                *words,
            )
        words = ["--columns", COLUMNS, "--rig", "free", "--known", "load_inertia=0"]
        run("identify", *logs, *words, "--out", str(Path(folder) / "found"))
        take_screenshot(Path(folder) / "found" / "report.html", out, Path(folder))


def sheet(frames: Mapping[str, np.ndarray], columns: int) -> Image.Image:
    """Arrange frames of equal size in a grid, each below its name."""
    width = next(iter(frames.values())).shape[1]
    cells = [
        np.vstack([frame, draw_text(name, width, 40)[..., :3]]) for name, frame in frames.items()
    ]
    cells += [np.full_like(cells[0], 255)] * (-len(cells) % columns)
    rows = [np.hstack(cells[start : start + columns]) for start in range(0, len(cells), columns)]
    return Image.fromarray(np.vstack(rows))


def tasks(out: Path) -> None:
    """Draw the six tasks."""
    frames = {}
    for name in TASKS:
        env = codrl_mj.make(name, render_mode="rgb_array", width=480, height=360, pretty=True)
        env.reset(seed=0)
        unwrapped: Any = env.unwrapped
        unwrapped.state = np.array(POSES[name])
        frames[name] = np.asarray(env.render())
        env.close()
    smaller(sheet(frames, 3), out)


def robots(out: Path) -> None:
    """Draw third-party environments with motors after 0.4 s of random actions."""
    frames = {}
    for name, actuator in ROBOTS.items():
        env = codrl_mj.make(name, actuator, render_mode="rgb_array", width=480, height=360)
        env.action_space.seed(0)
        env.reset(seed=0)
        unwrapped: Any = env.unwrapped
        for _ in range(math.ceil(0.4 / unwrapped.dt)):
            env.step(env.action_space.sample())
        frames[f"{name} on {actuator}"] = np.asarray(env.render())
        env.close()
    smaller(sheet(frames, 2), out)


PICTURE_MODULES = "page_pictures_motors", "page_pictures_runs", "page_pictures_tasks"


def pictures() -> dict[str, Callable[[Path], None]]:
    """Return the functions of all pictures, by name."""
    functions: dict[str, Callable[[Path], None]] = {
        "motor.png": motor,
        "log.png": log,
        "tasks.png": tasks,
        "robots.png": robots,
    }
    for name in PICTURE_MODULES:
        if (Path(__file__).parent / f"{name}.py").is_file():
            functions |= importlib.import_module(name).PICTURES
    return functions


def main() -> None:
    """Make the named pictures, or all."""
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
