"""Identification of random known motors from simulated logs with and without faults.

`python -m tests.identify.draws --draws 100` prints a table of excitations, with `--faults` a table
of faults of a PRBS log: rates, errors and messages.
"""

import argparse
import collections
import dataclasses
import math

import numpy as np

from codrl_mj.actuators import Drive, GearMotor, SampledLoop, Supply
from codrl_mj.identify import identify
from codrl_mj.identify.checks import check
from codrl_mj.identify.synthetic import Excitation, Sampler, Sensor, simulate, simulate_drive

VOLTS = 12.0
NAMES = {
    "R": "resistance",
    "L": "inductance",
    "kE": "back_emf_constant",
    "J": "inertia",
    "Coulomb": "coulomb_friction",
    "viscous": "viscous_friction",
    "friction": "friction_torque",
}
GOALS = {
    "R": 0.02,
    "L": 0.1,
    "kE": 0.02,
    "J": 0.05,
    "Coulomb": 0.05,
    "viscous": 0.05,
    "friction": 0.05,
}
"""Largest relative errors of parameters that count as identified."""
EXCITATIONS = ("prbs", "locked_prbs", "chirp", "square", "slow_sine")
SLOW = {"rate": 1000.0}
ROWS = {
    **{f"{kind} 5 kHz": {"kind": kind} for kind in EXCITATIONS},
    **{f"{kind} 1 kHz": {"kind": kind, **SLOW} for kind in EXCITATIONS},
    **{
        f"{kind} 5 kHz, instantaneous": {"kind": kind, "voltage": "instantaneous"}
        for kind in EXCITATIONS
    },
    **{
        f"{kind} 1 kHz, together": {"kind": kind, "voltage": "together", **SLOW}
        for kind in EXCITATIONS[:2]
    },
    "prbs 5 kHz, jitter 10 %": {"jitter": 0.1},
    "prbs 5 kHz, encoder of 512 steps": {"encoder": 512},
}
"""Name -> arguments of `make_log`.

The voltage of a row is its mean until the next row; its instantaneous value, with a separate clock;
or a voltage that changes together with the rows and is held until the next one.
"""


def random_motor(draw: int) -> GearMotor:
    """Return a random motor.

    It has 0.5 to 5 ohm, L/R of 0.3 to 1 ms, a mechanical time constant of 10 to 60 ms, and friction
    of 3 to 11 % of the torque.
    """
    random = np.random.default_rng(draw)

    def between(low, high):
        return float(np.exp(random.uniform(np.log(low), np.log(high))))

    resistance, constant = between(0.5, 5.0), between(0.02, 0.06)
    stall, fastest = 0.5 * VOLTS * constant / resistance, 0.5 * VOLTS / constant
    return GearMotor(
        resistance,
        resistance * between(0.3e-3, 1e-3),
        constant,
        constant,
        between(10e-3, 60e-3) * constant**2 / resistance,
        coulomb_friction=between(0.02, 0.06) * stall,
        viscous_friction=between(0.01, 0.05) * stall / fastest,
    )


def make_log(
    draw,
    kind="prbs",
    rate=5000.0,
    voltage="mean",
    jitter=0.0,
    dropped=0.0,
    encoder=4096,
    sag=0.0,
    **sensors,
):
    """Return a log of 3 s of a random motor, with 1 % of noise on the current and an encoder."""
    motor = random_motor(draw)
    drive = Drive(motor, SampledLoop(), Supply(VOLTS, sag * motor.resistance))
    clock = 4.0 * motor.electrical_time_constant
    if voltage == "together":
        clock = 2 * max(round(0.5 * clock * rate), 1) / rate
    excitation = Excitation(
        kind, 0.5 * VOLTS, 3.0, frequency=2.0 if kind == "square" else 0.5, clock=clock
    )
    peak = float(np.abs(simulate_drive(drive, excitation).signals["current"]).max())
    all_sensors = {
        "current": Sensor(0.01 * peak),
        "position": Sensor(resolution=2.0 * math.pi / encoder),
    }
    for name, changes in sensors.items():
        all_sensors[name] = dataclasses.replace(all_sensors.get(name, Sensor()), **changes)
    log = simulate(
        drive,
        excitation,
        sensors=all_sensors,
        sampler=Sampler(rate, jitter, dropped, voltage == "mean"),
        seed=draw,
    )
    return select_signals(
        log, "voltage", "current", *(() if kind == "locked_prbs" else ("position",))
    )


def select_signals(log, *names):
    """Return a log with only some of its signals."""
    return dataclasses.replace(log, signals={name: log.signals[name] for name in names})


def scale_signals(log, **factors):
    """Return a log with signals multiplied by factors."""
    signals = {name: factors.get(name, 1.0) * values for name, values in log.signals.items()}
    resolution = {name: abs(factors.get(name, 1.0)) * step for name, step in log.resolution.items()}
    return dataclasses.replace(log, signals=signals, resolution=resolution)


def advance_voltage(log, rows):
    """Return a log whose voltage is logged a number of rows too early."""
    return dataclasses.replace(
        log, signals={**log.signals, "voltage": np.roll(log.signals["voltage"], -rows)}
    )


def assume_uniform_times(log):
    """Return a log with uniform times, as if no row were missing and all steps were equal."""
    return dataclasses.replace(log, time=np.arange(len(log.time)) * log.step)


def declare_mean(log, mean):
    """Return a log whose voltage is declared as a mean or as held."""
    return dataclasses.replace(log, mean_voltage=mean)


def stall_current(draw):
    """Return the current [A] of a locked motor at the supply's voltage."""
    return VOLTS / random_motor(draw).resistance


def add_outliers(log, name):
    """Return a log with 0.5 % of outliers in a signal."""
    random, values = np.random.default_rng(0), log.signals[name].copy()
    values[random.choice(len(values), len(values) // 200, replace=False)] += 5.0 * np.std(values)
    return dataclasses.replace(log, signals={**log.signals, name: values})


FAULTS = {
    "none": make_log,
    "voltage 1 row early": lambda draw: advance_voltage(make_log(draw), 1),
    "voltage 6 rows early": lambda draw: advance_voltage(make_log(draw), 6),
    "supply sags by 0.15 R": lambda draw: make_log(draw, sag=0.15),
    "current 10 % too large": lambda draw: scale_signals(make_log(draw), current=1.1),
    "current offset by 2 % of its largest": lambda draw: make_log(
        draw, current={"bias": 0.02 * stall_current(draw)}
    ),
    "5 % of the rows missing": lambda draw: make_log(draw, dropped=0.05),
    "missing rows, taken for uniform": lambda draw: assume_uniform_times(
        make_log(draw, dropped=0.05)
    ),
    "stamps jitter by 10 %": lambda draw: make_log(draw, jitter=0.1),
    "jitter, taken for uniform": lambda draw: assume_uniform_times(make_log(draw, jitter=0.1)),
    "0.5 % outliers of the current": lambda draw: make_log(draw, current={"outliers": 0.005}),
    "0.5 % outliers of the position": lambda draw: make_log(draw, position={"outliers": 0.005}),
    "0.5 % outliers of the voltage": lambda draw: add_outliers(make_log(draw), "voltage"),
    "encoder of 512 steps": lambda draw: make_log(draw, encoder=512),
    "sign of the current": lambda draw: scale_signals(make_log(draw), current=-1.0),
    "sign of the voltage": lambda draw: scale_signals(make_log(draw), voltage=-1.0),
    "sign of the position": lambda draw: scale_signals(make_log(draw), position=-1.0),
    "mA for A": lambda draw: scale_signals(make_log(draw), current=1e3),
    "degrees for radians": lambda draw: scale_signals(make_log(draw), position=180.0 / math.pi),
    "time in ms": lambda draw: dataclasses.replace(make_log(draw), time=1e3 * make_log(draw).time),
    "a voltage of the rows' times, called mean": lambda draw: declare_mean(
        make_log(draw, voltage="instantaneous"), True
    ),
    "a mean, called the voltage of the row": lambda draw: declare_mean(make_log(draw), False),
}


def identify_draw(make_draw_log, draw):
    """Check and identify the log of a draw.

    Returns:
        Status, relative error and True if the truth is within the interval, by short name; and the
        messages.
    """
    motor, log = random_motor(draw), make_draw_log(draw)
    messages = [
        f"{finding.check} ({finding.severity})"
        for finding in check(log)
        if finding.severity != "info"
    ]
    try:
        result = identify([log], "free" if log.has("position") else None, seed=draw)
    except ValueError as error:
        return {}, [*messages, str(error)[:40]]
    messages += ["residuals" for text in result.warnings if "residuals" in text][:1]
    messages += [f"{part} {rows:+g} rows" for part, rows in result.delays.items() if rows]
    estimates, outcomes = {estimate.name: estimate for estimate in result.estimates}, {}
    for short, name in NAMES.items():
        if name in estimates:
            number, truth = estimates[name], _true_value(motor, estimates, name)
            outcomes[short] = (
                number.status,
                number.value / truth - 1.0,
                number.low <= truth <= number.high,
            )
    return outcomes, sorted(set(messages))


def _true_value(motor, estimates, name):
    """Return the true value of a parameter."""
    # The total friction depends on the speed at which the fit adds up its kinds.
    if name == "friction_torque":
        coulomb, viscous = estimates["coulomb_friction"].value, estimates["viscous_friction"].value
        return (
            motor.coulomb_friction
            + motor.viscous_friction * (estimates[name].value - coulomb) / viscous
        )
    return motor.rotor_inertia if name == "inertia" else getattr(motor, name)


def format_cell(outcomes):
    """Return the counts and the largest error of a parameter in all draws, as text."""
    texts = []
    for status in ("identified", "rough"):
        errors = [(error, inside) for outcome, error, inside in outcomes if outcome == status]
        if errors or status == "identified":
            worst = f", {100.0 * max(abs(error) for error, _ in errors):.2g} %" if errors else ""
            texts.append(f"{len(errors)}, {sum(inside for _, inside in errors)}{worst}")
    return "; rough ".join(texts)


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--draws", type=int, default=100)
    parser.add_argument("--faults", action="store_true")
    parser.add_argument("--only", nargs="*", help="full names of the rows to compute")
    options = parser.parse_args()
    rows = (
        FAULTS
        if options.faults
        else {name: lambda draw, row=row: make_log(draw, **row) for name, row in ROWS.items()}
    )
    print(
        f"of {options.draws} draws: identified, of these within the interval, largest error; rough:"
        " the same"
    )
    print(
        f"| | {' | '.join(NAMES)} | beyond the goal | said |\n| --- |"
        f" {'--- | ' * (len(NAMES) + 1)}--- |"
    )
    for name in options.only or rows:
        results = [identify_draw(rows[name], draw) for draw in range(options.draws)]
        cells, exceeded = [], {}
        for short in NAMES:
            outcomes = [numbers[short] for numbers, _ in results if short in numbers]
            cells.append(format_cell(outcomes))
            if count := sum(
                status == "identified" and abs(error) > GOALS[short]
                for status, error, _ in outcomes
            ):
                exceeded[short] = count
        messages = dict(collections.Counter(text for _, texts in results for text in texts))
        print(f"| {name} | {' | '.join(cells)} | {exceeded or ''} | {messages} |", flush=True)


if __name__ == "__main__":
    main()
