"""Write docs/actuators_in_numbers.md and its two CSV files: bench results of all named actuators.

Torques and speeds are measured in the engine, on one hinge: blocked, turned slowly by a heavy load,
or free. The loops of the catalogue's motors and their continuous torques are `codrl_mj.sizing`'s.
`make docs` runs it; a test compares the files with what it would write.
"""

import argparse
import csv
import dataclasses
import functools
import math
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

import codrl_mj
from codrl_mj.actuators import NAMED, Drive
from codrl_mj.catalogue import joint_names, motor_entry, motor_names
from codrl_mj.runs.files import atomic_write
from codrl_mj.sizing import analyze_loop, find_drive, torque_limits
from codrl_mj.study.bench import BLOCKED_INERTIA, make_bench
from codrl_mj.tasks import PAPER_TASKS, named_actuator
from codrl_mj.validation.motor_catalogue import NO_HEATING

FOLDER = Path(__file__).parent.parent / "docs"
PAGE = "actuators_in_numbers.md"
TABLES = {"tasks": "actuators_in_numbers_tasks.csv", "motors": "actuators_in_numbers_motors.csv"}
TASKS = {task.name: task for task in PAPER_TASKS}
"""Built-in tasks, which have the paper's actuators."""
LONG = 200.0
"""Time [s] after which the slowest current loop of the tasks has settled."""


def settled(torques: np.ndarray, band: float) -> int:
    """Return the step from which the torque, shape (steps,), stays within `band` of its end."""
    wrong = np.flatnonzero(np.abs(torques / torques[-1] - 1.0) > band)
    return int(wrong[-1]) + 1 if len(wrong) else 0


def free_run(
    actuator: Any, timestep: float, inertia: float, time_constant: float
) -> tuple[float, float]:
    """Return the joint's no-load speed [rad/s] and the time constant [s] of reaching it.

    The time constant is the area between no-load speed and speed, divided by the no-load speed.
    It is the sum of all time constants minus the winding's, whatever the inductance: torque and
    back-EMF are evaluated with the speed at a step's start, and so is the area.

    Args:
        actuator: actuator on the bench.
        timestep: integration step [s].
        inertia: inertia of the load [kg*m^2].
        time_constant: rough estimate [s] of the time constant; the run lasts 20 times as long.
    """
    # 1e6 is far beyond every limit: the actuator drives the load as hard as it can.
    speeds = make_bench(actuator, timestep, inertia)(1e6, 20.0 * time_constant)[:, 2]
    return float(speeds[-1]), float(timestep * (1.0 + np.sum(1.0 - speeds / speeds[-1])))


def task_row(task: str, name: str) -> dict[str, Any]:
    """Measure a named actuator on a task's bench: step to the largest force, stall, free run."""
    spec, actuator = TASKS[task], named_actuator(name, task)
    timestep, motor = spec.step_duration / spec.motor_inner_steps, actuator.motor
    max_force, blocked = float(spec.max_forces[0]), make_bench(actuator, timestep, BLOCKED_INERTIA)
    torques = blocked(max_force, LONG)[:, 0]
    row: dict[str, Any] = {"task": task, "actuator": name}
    for band in (5, 2):
        seconds = settled(torques, band / 100) * timestep
        row |= {f"settled_{band}_steps": seconds / spec.step_duration, f"settled_{band}_s": seconds}
    product = (
        motor.torque_constant * motor.back_emf_constant / motor.resistance / actuator.arm_radius**2
    )

    return row | {
        "first_step_percent": 100.0 * torques[spec.motor_inner_steps - 1] / max_force,
        # Adding 0.0 turns a negative zero into zero.
        "steady_error_percent": round(100.0 * (torques[-1] / max_force - 1.0), 6) + 0.0,
        "stall_torque": blocked(1e6, 50.0 * motor.electrical_time_constant)[-1, 0],
        "no_load_speed": free_run(actuator, timestep, 50.0 * timestep * product, 50.0 * timestep)[
            0
        ],
        "slide": _on_a_slide(task),
    }


@functools.cache
def _on_a_slide(task: str) -> bool:
    environment: Any = codrl_mj.EnvConfig(task, "ideal").build()
    model = environment.unwrapped.model
    kind = model.jnt_type[model.actuator(TASKS[task].motors[0]).trnid[0]]
    environment.close()
    return bool(kind == mujoco.mjtJoint.mjJNT_SLIDE)


def motor_row(name: str) -> dict[str, Any]:
    """Measure a motor of the catalogue, cold, at its nominal voltage (or 24 V) and its own gear."""
    drive, numbers = find_drive(name), motor_entry(name).parameters
    loop = analyze_loop(drive)
    # Stall and no load are properties of the motor, so the controller does not limit the current.
    cold = dataclasses.replace(drive.motor, **NO_HEATING)
    free = dataclasses.replace(
        drive, motor=cold, controller=dataclasses.replace(drive.controller, max_current=math.inf)
    )
    speed, time_constant = _free(free)
    continuous = numbers.continuous_current
    return {
        "motor": name,
        "gear_ratio": numbers.gear_ratio,
        "resistance": numbers.resistance,
        "inductance": numbers.inductance,
        "torque_constant": numbers.torque_constant,
        "back_emf_constant": numbers.back_emf_constant,
        "rotor_inertia": math.nan if numbers.rotor_inertia is None else numbers.rotor_inertia,
        "estimated": " ".join(motor_entry(name).estimated),
        "voltage": drive.voltage_limit,
        "settled_2_ms": 1e3 * loop.settling_time,
        "bandwidth_hz": loop.bandwidth,
        "stall_torque": _stall(free, speed),
        "no_load_speed": speed,
        "continuous_torque": (
            math.nan if continuous is None else float(torque_limits(free, 0.0, continuous)[1])
        ),
        "mechanical_time_constant_ms": (
            math.nan if numbers.rotor_inertia is None else 1e3 * time_constant
        ),
    }


def _free(drive: Drive) -> tuple[float, float]:
    """Return `free_run` of the bare rotor, or with a 20 ms load if its inertia is unknown."""
    motor, rate = drive.motor, drive.controller.sample_rate
    product = (
        motor.torque_constant * motor.back_emf_constant * motor.gear_efficiency / motor.resistance
    )
    known = motor.rotor_inertia > 0.0
    time_constant = motor.rotor_inertia / product if known else 0.02
    timestep = max(math.floor(time_constant / 100.0 * rate), 1) / rate
    # MuJoCo needs a load with an inertia; 1e-13 kg*m^2 is nothing beside a rotor.
    inertia = 1e-13 if known else 0.02 * product / drive.arm_radius**2
    return free_run(drive, timestep, inertia, time_constant)


def _stall(drive: Drive, no_load_speed: float) -> float:
    """Return the stall torque [N*m] at the output, extrapolated from 1 and 2 % of no-load speed."""
    duration = max(50.0 * drive.motor.electrical_time_constant, 2e-3)
    max_torque = (
        drive.motor.torque_constant
        * drive.voltage_limit
        / drive.motor.resistance
        / drive.arm_radius
    )
    # A motor that stands still may be held by friction, so it is turned slowly by a heavy load.
    bench = make_bench(
        drive, 1.0 / drive.controller.sample_rate, 1e4 * max_torque * duration / no_load_speed
    )
    slow, less_slow = (bench(1e6, duration, share * no_load_speed)[-1, 1] for share in (0.01, 0.02))
    return float(2.0 * slow - less_slow)


def rows() -> dict[str, list[dict[str, Any]]]:
    """Measure the rows of both tables."""
    named = [name for name in NAMED if name != "ideal"]
    return {
        "tasks": [task_row(task, name) for task in TASKS for name in named],
        "motors": [motor_row(name) for name in motor_names()],
    }


def _number(value: Any, digits: int = 3) -> str:
    """Format a number with few digits; "–" if it is not finite."""
    value = float(value)
    if not math.isfinite(value):
        return "–"
    return f"{value:,.0f}" if abs(value) >= 10**digits else f"{value + 0.0:.{digits}g}"


def _table(heads: Iterable[str], body: Iterable[Iterable[str]]) -> str:
    lines = [list(heads), *([["---"] * len(list(heads))]), *map(list, body)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _ranges(rows: list[dict[str, str]], column: str) -> list[str]:
    """Return the minimum and maximum over the tasks of each actuator's value."""
    values: dict[str, list[float]] = {}
    for row in rows:
        values.setdefault(row["actuator"], []).append(float(row[column]))
    return [
        " to ".join(dict.fromkeys([_number(min(actuator_values)), _number(max(actuator_values))]))
        for actuator_values in values.values()
    ]


def _motor_line(row: dict[str, str]) -> list[str]:
    """Return a motor's row of the page: printed values, then measured ones."""
    entry = motor_entry(row["motor"])
    measured = ("stall_torque", "no_load_speed", "continuous_torque")
    return [
        f"`{row['motor']}`" + (" t" if entry.parameters.thermal_resistance else ""),
        *(_number(row[name]) for name in ("voltage", "gear_ratio", *measured)),
    ]


def _joint_line(name: str) -> list[str]:
    """Return the row of a motor that is known only by its torque-speed line."""
    line = motor_entry(name).line
    assert line is not None
    peak = line.stall_torque if line.max_torque is None else line.max_torque
    values = (line.stall_torque, line.no_load_speed, peak)
    return [f"`{name}`", *map(_number, values)]


def page(tables: Mapping[str, list[dict[str, str]]]) -> str:
    """Return the Markdown page, from the rows of the CSV files and the catalogue."""
    tasks, motors = tables["tasks"], tables["motors"]
    heads = ("motor", "V", "gear", "stall [N·m]", "no load [rad/s]", "continuous [N·m]")
    joint_heads = ("motor", "stall [N·m]", "no load [rad/s]", "largest [N·m]")
    actuator_names = [f"`{name}`" for name in dict.fromkeys(row["actuator"] for row in tasks)]
    paper = {
        "settling time to within 2 % [s]": "settled_2_s",
        "torque at the end of the first policy step [%]": "first_step_percent",
    }
    loop = motors[0]
    return f"""# Actuators in numbers

This page lists the response of every named [actuator](actuators.md). It is measured in simulation
on one hinge that is either blocked or free to turn. The CSV files have more values:
[tasks]({TABLES["tasks"]}), [motors]({TABLES["motors"]}).

![Share of the largest force that each of the paper's actuators delivers](pictures/actuators_in_numbers.png)

## The paper's actuators

The desired force steps from zero to the task's largest force. Each entry is the range over the
tasks. A settling time of 0 means that the force settles within the first integration step. All
forces have settled after {LONG:g} s.

{_table(["", *actuator_names], [[words, *_ranges(tasks, column)] for words, column in paper.items()])}

## The catalogue

Each motor has its own gear and its nominal voltage (24 V if the datasheet prints none). The
winding is cold, and the current is not limited. With a current loop at 20 kHz (bandwidth
{_number(loop["bandwidth_hz"], 4)} Hz) the current settles in {_number(loop["settled_2_ms"])} ms.

{_table(heads, map(_motor_line, motors))}

Torques are net torques at the output, after friction. The *continuous* torque belongs to the
largest current that the winding can carry continuously. A "t" after the name marks motors with
thermal values. A "–" marks values that the datasheet does not print. Stall torque and no-load
speed are measured in simulation and agree with the printed values within 5 %, except where
`codrl-mj motor show NAME` lists a larger contradiction within the datasheet.

## Motors without a winding

Of these, only a [torque-speed line](motors.md#without-a-winding) is published, at the output:

{_table(joint_heads, map(_joint_line, joint_names()))}

`codrl-mj motor show NAME` prints the source of every value and contradictions in the datasheet.
"""


def _write(measured: list[dict[str, Any]], path: Path) -> list[dict[str, str]]:
    """Write a table, and return its rows as the file has them."""
    texts = [
        {
            key: f"{value:.6g}" if isinstance(value, float) else f"{value}"
            for key, value in row.items()
        }
        for row in measured
    ]
    with atomic_write(path) as temporary, temporary.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(texts[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(texts)
    return texts


def main() -> int:
    """Write the page and its tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=FOLDER, help="folder for the files")
    options = parser.parse_args()
    tables = {
        kind: _write(measured, options.out / TABLES[kind]) for kind, measured in rows().items()
    }
    with atomic_write(options.out / PAGE) as temporary:
        temporary.write_text(page(tables))
    print("\n".join(f"wrote {options.out / name}" for name in TABLES.values()))
    print(f"wrote {options.out / PAGE}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
