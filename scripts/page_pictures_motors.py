"""Pictures of the pages on motors, actuators and environments; `make pictures` makes them with the others.

PICTURES has a function for each, which takes the path to write. All but two are what a command of
its page draws.
"""

import re
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from codrl_mj.actuators import Drive, GearMotor, Lag, SampledLoop, Supply, TorqueSpeed
from codrl_mj.cli import main
from codrl_mj.study.bench import BLOCKED_INERTIA, make_bench
from codrl_mj.tasks import OURS, named_actuator
from codrl_mj.viz.pages.plots import Curve, Plot, save

DOCS = Path(__file__).parents[1] / "docs"


def run(*words: str) -> None:
    """A command of ours, which has to succeed."""
    if main(list(words)) != 0:
        raise SystemExit(f"codrl-mj {' '.join(words)} failed")


def smaller(picture: Path, out: Path, width: int = 840) -> None:
    """Write a picture with a palette of 256 colours."""
    with Image.open(picture) as image:
        width = min(width, image.width)
        size = width, round(image.height * width / image.width)
        image.convert("RGB").resize(size, Image.Resampling.LANCZOS).quantize(256).save(
            out, optimize=True
        )


def motor_design(out: Path) -> None:
    """The loop that docs/motors.md designs: gain and phase, with margins."""
    with tempfile.TemporaryDirectory() as made:
        run(
            "motor",
            "design",
            "quanser-qube-servo-2",
            "--bandwidth",
            "1500",
            "--delayed",
            "--out",
            made,
        )
        smaller(Path(made, "bode.png"), out, 720)


def own_motor(out: Path) -> None:
    """The motor that docs/motors.md writes down."""
    written = re.search(r"```toml\n(.*?)```", (DOCS / "motors.md").read_text(), re.DOTALL)
    with tempfile.TemporaryDirectory() as made:
        Path(made, "my_motor.toml").write_text(written[1] if written else "")
        run("motor", "show", str(Path(made, "my_motor.toml")), "--out", made)
        smaller(Path(made, "torque_speed.png"), out)


def own_robot(out: Path) -> None:
    """Five frames of the film of docs/own_robot.md, one above the other."""
    example = DOCS.parent / "examples" / "own_robot" / "ball_and_beam.py"
    with tempfile.TemporaryDirectory() as made:
        trained, film = Path(made, "ball"), Path(made, "film")
        run("train", f"{example}:TASK", "--total-steps", "100000", "--out", str(trained))
        run(
            "render",
            str(trained),
            "--trust",
            "--seed",
            "1",
            "--env.max-episode-steps",
            "50",
            "--out",
            str(film),
        )
        strips = []
        for frame in (0, 4, 8, 12, 24):
            with Image.open(film / f"frame_{frame:05d}.png") as image:
                strips.append(image.convert("RGB").crop((140, 260, 500, 360)))
    stacked = Image.new("RGB", (360, 100 * len(strips)))
    for row, strip in enumerate(strips):
        stacked.paste(strip, (0, 100 * row))
    stacked.quantize(64).save(out, optimize=True)


def foreign(out: Path) -> None:
    """A frame of the film of docs/foreign.md: HalfCheetah, its motors, random actions."""
    with tempfile.TemporaryDirectory() as made:
        film = (
            "--motor",
            "bthigh",
            "--env.max-episode-steps",
            "60",
            "--height",
            "300",
            "--out",
            str(Path(made, "film")),
        )
        run("render", "HalfCheetah-v5", "--actuator", "maxon-ec45-flat-50w", *film)
        smaller(sorted(Path(made, "film").glob("*.png"))[-1], out, 640)


def actuators(out: Path) -> None:
    """What families deliver of a torque that is asked for on a joint that turns freely, up to their speed limit."""
    motor = GearMotor(
        resistance=1.0,
        inductance=1e-3,
        torque_constant=0.05,
        back_emf_constant=0.05,
        gear_ratio=10.0,
    )
    families: dict[str, Any] = {
        "drive": Drive(motor, SampledLoop(10e3), Supply(12.0)),
        "current_loop (weak)": named_actuator("weak", "pendulum"),
        "lag": Lag(0.1),
        "torque_speed": TorqueSpeed(stall_torque=5.0, no_load_speed=30.0, max_torque=3.5),
    }
    timestep, asked, inertia = 1e-3, 4.0, 0.2
    times = timestep * np.arange(1, 1501)
    curves = [
        Curve(name, times, make_bench(one, timestep, inertia)(asked, times[-1])[:, 0])
        for name, one in families.items()
    ]
    ideal = Curve("ideal", times, np.full_like(times, asked), reference=True, dashed=True)
    title = "4 N·m asked for, on a joint that is free to turn"
    save(Plot(title, "time [s]", "torque at the joint [N·m]", (*curves, ideal)), out, (7.0, 3.8))
    smaller(out, out)


def actuators_in_numbers(out: Path) -> None:
    """Shares of the largest force that the paper's actuators deliver on a blocked joint, on three tasks."""
    plots = []
    for task in (
        one for one in OURS if one.name in ("pendulum", "cartpole", "acrobot", "mountain_car")
    ):
        timestep = task.step_duration / task.motor_inner_steps
        curves = []
        for name in ("paper", "weak", "weaker", "open_loop"):
            torques = make_bench(named_actuator(name, task.name), timestep, BLOCKED_INERTIA)(
                float(task.max_forces[0]), 8.0
            )[:, 0]
            times = timestep * np.arange(len(torques) + 1)
            curves.append(
                Curve(name, times, np.concatenate([[0.0], torques]) / float(task.max_forces[0]))
            )
        plots.append(Plot(task.name, "time [s]", "share of the largest force", tuple(curves)))
    save(plots, out)
    smaller(out, out)


PICTURES: dict[str, Callable[[Path], None]] = {
    "motor_design.png": motor_design,
    "own_motor.png": own_motor,
    "own_robot.png": own_robot,
    "foreign.png": foreign,
    "actuators.png": actuators,
    "actuators_in_numbers.png": actuators_in_numbers,
}
"""Name in docs/pictures -> what writes it."""
