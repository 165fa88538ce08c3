"""Identify random servos from simulated logs, and the XL330 from its published logs.

`python scripts/study_servo_fit.py draws --draws 100 --out rows.csv` fits logs of simulations that
are not ours (`servo_simulators.py`), continues an interrupted file, and prints a summary; with
`--only-page` it only writes the summary into `docs/identify_servo_measured.csv`.
`python scripts/study_servo_fit.py xl330 --logs data/bench_logs/bam_xl330 --parameters params`
predicts the logs of each gain by a fit of the other gains, and by BAM's parameters.
"""

import argparse
import csv
import json
import math
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

import servo_simulators
from codrl_mj.identify import read_log
from codrl_mj.identify.servo import identify_servo

SUMMARY = Path(__file__).parent.parent / "docs" / "identify_servo_measured.csv"
FRICTION = {"bam_m3": "load"}
"""Kind of simulation -> friction model of the fit, if it is not `coulomb`."""
UNTOLD = {"mujoco_position": ("duty_gain",), "bam_m3": ("coulomb_friction",)}
"""Kind of simulation -> parameters that it does not have in our sense."""
GAINS = (100, 200, 800)
COLUMNS = (
    "time=timestamp:s,position=position:rad,command=goal_position:rad,gain=kp:1,only=torque_enable"
)
ERROR_GAIN, VOLTS, STEP = 0.00246, 7.4, 0.005
"""Duty per angle error and register, supply [V] and time step [s] of BAM's XL330."""


class Comparison(NamedTuple):
    """A fitted parameter and its truth."""

    kind: str  # of the simulation
    seed: int
    name: str
    truth: float
    value: float
    low: float
    high: float
    status: str


class Accuracy(NamedTuple):
    """Accuracy of a parameter over the logs of a kind of simulation."""

    simulation: str
    parameter: str
    logs: int
    identified: int  # number of logs
    inside_interval: int  # number of the identified ones
    median_half_width: str  # of the identified ones: absolute, or relative to the value


def fit_draw(kind: str, seed: int) -> list[Comparison]:
    """Compare the parameters of a fit with their truth."""
    servo = servo_simulators.draw(seed, kind)
    log = servo_simulators.servo_log(servo, kind, seed)
    result = identify_servo([log], known=servo.known, friction=FRICTION.get(kind, "coulomb"))
    rows = []
    for estimate in result.estimates:
        truth = servo.truth.get(estimate.name)
        if truth is None or estimate.status == "given" or estimate.name in UNTOLD.get(kind, ()):
            continue
        value, low, high = (
            float(f"{number:.6g}") for number in (estimate.value, estimate.low, estimate.high)
        )
        truth = float(f"{truth:.6g}")
        row = Comparison(kind, seed, estimate.name, truth, value, low, high, estimate.status)
        rows.append(row)
    return rows


def study_draws(path: Path, seeds: Iterable[int], kinds: Sequence[str]) -> None:
    """Fit the servos of seeds that are not in a file yet, and append their rows."""
    fitted = {(row.kind, row.seed) for row in read_rows(path)}
    with path.open("a", newline="") as file:
        writer = csv.writer(file)
        for seed in seeds:
            for kind in kinds:
                if (kind, seed) not in fitted:
                    writer.writerows(fit_draw(kind, seed))
                    file.flush()


def read_rows(path: Path) -> list[Comparison]:
    """Return the rows of a file; none if it does not exist."""
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return [
            Comparison(
                *(kind, int(seed), name, float(truth), float(value), float(low), float(high)),
                status,
            )
            for kind, seed, name, truth, value, low, high, status in csv.reader(file)
        ]


def summarize(rows: Iterable[Comparison]) -> list[Accuracy]:
    """Return the accuracy of each parameter in each kind of simulation."""
    groups: dict[tuple[str, str], list[Comparison]] = {}
    for row in rows:
        groups.setdefault((row.kind, row.name), []).append(row)
    summary = []
    for (kind, name), group in groups.items():
        identified = [row for row in group if row.status == "identified"]
        inside = sum(row.low <= row.truth <= row.high for row in identified)
        widths = [(row.high - row.low) / 2.0 for row in identified]
        if name not in ("command_delay", "zero"):
            widths = [width / abs(row.value) for width, row in zip(widths, identified, strict=True)]
        width = f"{np.median(widths):.3g}" if widths else ""
        summary.append(Accuracy(kind, name, len(group), len(identified), inside, width))
    kinds = servo_simulators.KINDS
    return sorted(summary, key=lambda entry: (kinds.index(entry.simulation), entry.parameter))


def write_summary(rows: Iterable[Comparison]) -> None:
    """Write the summary into the documentation."""
    with SUMMARY.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(Accuracy._fields)
        writer.writerows(summarize(rows))


def bam_friction(
    parameters: Mapping[str, float], motor: float, external: float, speed: float
) -> float:
    """Return the friction torque of BAM's models M1, M4 and M6 [N*m], without viscous friction."""
    get = parameters.get
    stribeck = 0.0
    if "alpha" in parameters:
        ratio = abs(speed / parameters["dtheta_stribeck"])
        stribeck = math.exp(-(ratio ** parameters["alpha"]))
    friction = parameters["friction_base"] + stribeck * get("friction_stribeck", 0.0)
    load = get("load_friction_base", 0.0) + stribeck * get("load_friction_stribeck", 0.0)
    friction += load * abs(external - motor)
    for suffix, share in (("", 1.0), ("_stribeck", stribeck)):
        by_external = external * get(f"load_friction_external{suffix}", 0.0)
        friction += share * abs(by_external - motor * get(f"load_friction_motor{suffix}", 0.0))
    if external * motor <= 0.0 and abs(external) != abs(motor):
        is_motor = abs(external) < abs(motor)
        side, torque = ("external", external) if is_motor else ("motor", motor)
        friction += stribeck * get(f"load_friction_{side}_quad", 0.0) * torque**2
    return friction


def bam_error(path: Path, parameters: Mapping[str, float]) -> float:
    """Return the mean absolute error [rad] of a log simulated by BAM's equations."""
    content = json.loads(path.read_text())
    entries = content["entries"]
    stamps, position, goal, enabled, speeds = (
        np.array([float(entry[name]) for entry in entries])
        for name in ("timestamp", "position", "goal_position", "torque_enable", "speed")
    )
    times = np.arange(0.0, stamps[-1], STEP)
    goal, measured, enabled = (
        np.interp(times, stamps, values) for values in (goal, position, enabled)
    )
    constant, resistance = parameters["kt"], parameters["R"]
    inertia = content["mass"] * content["length"] ** 2 + parameters["armature"]
    mgl = content["mass"] * 9.80665 * content["length"]
    angle, speed, errors = measured[0], speeds[0], []
    for row in range(len(times)):
        errors.append(abs(angle - measured[row]))
        duty = min(max(ERROR_GAIN * content["kp"] * (goal[row] - angle), -1.0), 1.0)
        motor = constant * (VOLTS * duty - constant * speed) / resistance * (enabled[row] > 0.5)
        external = -mgl * math.sin(angle + parameters["q_offset"])
        friction = bam_friction(parameters, motor, external, speed)
        friction += parameters["friction_viscous"] * abs(speed)
        net = motor + external
        stop = inertia / STEP * speed + net
        acceleration = (net - math.copysign(min(abs(stop), friction), stop)) / inertia
        speed += acceleration * STEP
        angle += speed * STEP + 0.5 * acceleration * STEP**2
    return float(np.mean(np.array(errors)[enabled > 0.5]))


def study_xl330(folder: Path, parameters: Path) -> None:
    """Print the errors on the held-out logs of each gain, for our fits and for BAM's parameters."""
    logs = {path: read_log(path, COLUMNS) for path in sorted(folder.glob("*.json"))}
    known = {"mass": 0.49, "length": 0.1}
    errors: dict[tuple[str, int], list[float]] = {}
    for friction in ("load", "coulomb"):
        for gain in GAINS:
            fitted = [log for log in logs.values() if log.constants["kp"] != gain]
            held_out = [log for log in logs.values() if log.constants["kp"] == gain]
            result = identify_servo(fitted, "pendulum", known, friction, held_out)
            errors[friction, gain] = [
                log.closed_loop for log in result.held_out if log.closed_loop is not None
            ]
            print_errors(friction, gain, errors[friction, gain])
        print_errors(friction, "all", [error for gain in GAINS for error in errors[friction, gain]])
    for model in ("m1", "m4", "m6"):
        values = json.loads((parameters / f"{model}.json").read_text())
        for gain in GAINS:
            paths = [path for path, log in logs.items() if log.constants["kp"] == gain]
            errors[model, gain] = [bam_error(path, values) for path in paths]
            print_errors(f"BAM {model}", gain, errors[model, gain])
        print_errors(
            f"BAM {model}", "all", [error for gain in GAINS for error in errors[model, gain]]
        )


def print_errors(name: str, gain: int | str, errors: Sequence[float]) -> None:
    """Print errors in mrad, and their mean."""
    listed = " ".join(f"{1e3 * error:.0f}" for error in errors)
    print(f"{name:8} gain {gain}: mean {1e3 * np.mean(errors):.1f} mrad ({listed})", flush=True)


def main() -> int:
    """Run a study."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("study", choices=("draws", "xl330"))
    parser.add_argument("--draws", type=int, default=100, help="random servos of each kind")
    parser.add_argument("--first", type=int, default=0, help="seed of the first servo")
    parser.add_argument("--kinds", nargs="+", default=servo_simulators.KINDS)
    parser.add_argument("--out", type=Path, default=Path("servo_draws.csv"), help="rows")
    parser.add_argument("--only-page", action="store_true", help="write the summary, fit nothing")
    parser.add_argument("--logs", type=Path, help="folder of the XL330's logs")
    parser.add_argument("--parameters", type=Path, help="folder of BAM's m1.json, m4.json, m6.json")
    options = parser.parse_args()
    if options.study == "xl330":
        study_xl330(options.logs, options.parameters)
        return 0
    if not options.only_page:
        seeds = range(options.first, options.first + options.draws)
        study_draws(options.out, seeds, options.kinds)
    rows = read_rows(options.out)
    if options.only_page:
        write_summary(rows)
    for row in summarize(rows):
        print(*row)
    return 0


if __name__ == "__main__":
    sys.exit(main())
