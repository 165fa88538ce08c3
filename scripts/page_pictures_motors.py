"""Pictures of the pages on motors, actuators and environments, made by `make pictures`.

PICTURES has a function for each, which takes the output path. All but two pictures are drawn by a
command of their page.
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
from codrl_mj.plots import Curve, Plot, save_png
from codrl_mj.study.bench import BLOCKED_INERTIA, make_bench
from codrl_mj.tasks import PAPER_TASKS, named_actuator

DOCS = Path(__file__).parents[1] / "docs"


def run(*words: str) -> None:
    """Run a codrl-mj command; exit if it fails."""
    if main(list(words)) != 0:
        raise SystemExit(f"codrl-mj {' '.join(words)} failed")


def smaller(picture: Path, out: Path, width: int = 840) -> None:
    """Write a picture with a palette of 256 colors."""
    with Image.open(picture) as image:
        width = min(width, image.width)
        size = width, round(image.height * width / image.width)
        image.convert("RGB").resize(size, Image.Resampling.LANCZOS).quantize(256).save(
            out, optimize=True
        )


def motor_design(out: Path) -> None:
    """Draw the current loop that docs/motors.md designs: gain and phase, with margins."""
    with tempfile.TemporaryDirectory() as folder:
        run(
            "motor",
            "design",
            "quanser-qube-servo-2",
            "--bandwidth",
            "1500",
            "--delayed",
            "--out",
            folder,
        )
        smaller(Path(folder, "bode.png"), out, 720)


def custom_motor(out: Path) -> None:
    """Draw the motor that docs/motors.md defines."""
    written = re.search(r"```toml\n(.*?)```", (DOCS / "motors.md").read_text(), re.DOTALL)
    with tempfile.TemporaryDirectory() as folder:
        Path(folder, "my_motor.toml").write_text(written[1] if written else "")
        run("motor", "show", str(Path(folder, "my_motor.toml")), "--out", folder)
        smaller(Path(folder, "torque_speed.png"), out)


def custom_robot(out: Path) -> None:
    """Stack five frames of the film of docs/own_robot.md."""
    example = DOCS.parent / "examples" / "own_robot" / "ball_and_beam.py"
    with tempfile.TemporaryDirectory() as folder:
        trained, film = Path(folder, "ball"), Path(folder, "film")
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


def third_party_env(out: Path) -> None:
    """Write a frame of the film of docs/external_envs.md: HalfCheetah, its motors, random actions."""
    with tempfile.TemporaryDirectory() as folder:
        film = (
            "--motor",
            "bthigh",
            "--env.max-episode-steps",
            "60",
            "--height",
            "300",
            "--out",
            str(Path(folder, "film")),
        )
        run("render", "HalfCheetah-v5", "--actuator", "maxon-ec45-flat-50w", *film)
        smaller(sorted(Path(folder, "film").glob("*.png"))[-1], out, 640)


def actuators(out: Path) -> None:
    """Draw families' torques on a free joint after a step of the desired torque.

    The joint accelerates to the families' speed limits.
    """
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
    timestep, desired, inertia = 1e-3, 4.0, 0.2
    times = timestep * np.arange(1, 1501)
    curves = [
        Curve(name, times, make_bench(actuator, timestep, inertia)(desired, times[-1])[:, 0])
        for name, actuator in families.items()
    ]
    ideal = Curve("ideal", times, np.full_like(times, desired), reference=True, dashed=True)
    title = "4 N·m asked for, on a joint that is free to turn"
    save_png(
        Plot(title, "time [s]", "torque at the joint [N·m]", (*curves, ideal)), out, (7.0, 3.8)
    )
    smaller(out, out)


def actuators_in_numbers(out: Path) -> None:
    """Draw the share of the largest force that the paper's actuators deliver on blocked joints."""
    plots = []
    for task in (
        task
        for task in PAPER_TASKS
        if task.name in ("pendulum", "cartpole", "acrobot", "mountain_car")
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
    save_png(plots, out)
    smaller(out, out)


PICTURES: dict[str, Callable[[Path], None]] = {
    "motor_design.png": motor_design,
    "own_motor.png": custom_motor,
    "own_robot.png": custom_robot,
    "foreign.png": third_party_env,
    "actuators.png": actuators,
    "actuators_in_numbers.png": actuators_in_numbers,
}
"""Name in docs/pictures -> function that writes it."""
