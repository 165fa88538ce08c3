"""Make the README's pictures of what comes out: a motor under a task, and the report of an identification.

They are written to docs/pictures. Example: python scripts/pictures.py. It takes Chromium for pages.
"""

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

from codrl_mj.cli import main

PICTURES = Path(__file__).parents[1] / "docs" / "pictures"
COLUMNS = "time=time:s,voltage=voltage:V,current=current:A,position=position:rad"
CHROMIUM = ("--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--window-size=1280,860")
CHROMIUM_OFFLINE = ("--no-first-run", "--disable-background-networking", "--disable-component-update", "--disable-sync")


def run(*words: str) -> None:
    """A command of ours, which has to succeed."""
    if main(list(words)) != 0:
        raise SystemExit(f"codrl-mj {' '.join(words)} failed")


def smaller(picture: Path, out: Path, width: int = 960) -> None:
    """Write a picture with a palette of 128 colours."""
    with Image.open(picture) as image:
        size = width, round(image.height * width / image.width)
        image.convert("RGB").resize(size, Image.Resampling.LANCZOS).quantize(128).save(out, optimize=True)


def make(folder: Path) -> None:
    """Make them in a folder of no further use."""
    chromium = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if chromium is None:
        raise SystemExit("Chromium is not installed: apt-get install chromium")
    run("motor", "feasible", "maxon-ec45-flat-50w", "pendulum", "--gear-ratio", "20", "--out", str(folder / "motor"))
    smaller(folder / "motor" / "torque_speed.png", PICTURES / "motor.png")
    logs = [str(folder / f"swing{seed}.csv") for seed in (1, 2)]
    for seed, log in enumerate(logs, start=1):
        words = ["--kind", "prbs", "--amplitude", "8", "--rate", "5000", "--sensor", "current:noise=0.05"]
        run("identify", "simulate", "maxon-ec45-flat-50w", "--out", log, "--seed", str(seed), *words)
    found = str(folder / "found")
    run("identify", *logs, "--columns", COLUMNS, "--rig", "free", "--known", "load_inertia=0", "--out", found)
    shot, page = folder / "log.png", (folder / "found" / "report.html").as_uri()
    profile = f"--user-data-dir={folder / 'profile'}"
    subprocess.run([chromium, *CHROMIUM, *CHROMIUM_OFFLINE, profile, f"--screenshot={shot}", page], check=True)
    smaller(shot, PICTURES / "log.png")


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as made:
        make(Path(made))
    sys.exit(0)
