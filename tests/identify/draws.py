"""Motors of ours that are known, identified from logs with and without faults: how often, how well, and what is said.

`python -m tests.identify.draws --draws 100` prints a table of excitations, with `--faults` one of
faults of a PRBS log.
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
"""Relative errors within which what is identified is asked to be."""
KINDS = ("prbs", "locked_prbs", "chirp", "square", "slow_sine")
SLOW = {"rate": 1000.0}
ROWS = {
    **{f"{kind} 5 kHz": {"kind": kind} for kind in KINDS},
    **{f"{kind} 1 kHz": {"kind": kind, **SLOW} for kind in KINDS},
    **{
        f"{kind} 5 kHz, instantaneous": {"kind": kind, "voltage": "instantaneous"} for kind in KINDS
    },
    **{
        f"{kind} 1 kHz, together": {"kind": kind, "voltage": "together", **SLOW}
        for kind in KINDS[:2]
    },
    "prbs 5 kHz, jitter 10 %": {"jitter": 0.1},
    "prbs 5 kHz, encoder of 512 steps": {"encoder": 512},
}
"""Name -> arguments of `logged`. The voltage of a row: the mean to the next one; what it is at the
time, while it changes by a clock of its own; or what holds until the next one, changing together
with the rows.
"""


def motor_of(draw: int) -> GearMotor:
    """A motor of 0.5 to 5 ohm, L/R of 0.3 to 1 ms, a mechanical time constant of 10 to 60 ms, 3 to 11 % of friction."""
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


def logged(
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
    """The motor of a draw, its log of 3 s through 1 % of noise on the current and an encoder."""
    motor = motor_of(draw)
    drive = Drive(motor, SampledLoop(), Supply(VOLTS, sag * motor.resistance))
    clock = 4.0 * motor.electrical_time_constant
    if voltage == "together":
        clock = 2 * max(round(0.5 * clock * rate), 1) / rate
    excitation = Excitation(
        kind, 0.5 * VOLTS, 3.0, frequency=2.0 if kind == "square" else 0.5, clock=clock
    )
    peak = float(np.abs(simulate_drive(drive, excitation).signals["current"]).max())
    seen = {"current": Sensor(0.01 * peak), "position": Sensor(resolution=2.0 * math.pi / encoder)}
    for name, changes in sensors.items():
        seen[name] = dataclasses.replace(seen.get(name, Sensor()), **changes)
    log = simulate(
        drive,
        excitation,
        sensors=seen,
        sampler=Sampler(rate, jitter, dropped, voltage == "mean"),
        seed=draw,
    )
    return only(log, "voltage", "current", *(() if kind == "locked_prbs" else ("position",)))


def only(log, *names):
    return dataclasses.replace(log, signals={name: log.signals[name] for name in names})


def scaled(log, **factors):
    signals = {name: factors.get(name, 1.0) * values for name, values in log.signals.items()}
    resolution = {name: abs(factors.get(name, 1.0)) * step for name, step in log.resolution.items()}
    return dataclasses.replace(log, signals=signals, resolution=resolution)


def late(log, rows):
    """The voltage some rows before it is in force."""
    return dataclasses.replace(
        log, signals={**log.signals, "voltage": np.roll(log.signals["voltage"], -rows)}
    )


def uniform(log):
    """As if no row were missing, and every step the same."""
    return dataclasses.replace(log, time=np.arange(len(log.time)) * log.step)


def called(log, mean):
    return dataclasses.replace(log, mean_voltage=mean)


def largest(draw):
    return VOLTS / motor_of(draw).resistance


def spiky(log, name):
    """A signal with 0.5 % of outliers."""
    random, values = np.random.default_rng(0), log.signals[name].copy()
    values[random.choice(len(values), len(values) // 200, replace=False)] += 5.0 * np.std(values)
    return dataclasses.replace(log, signals={**log.signals, name: values})


FAULTS = {
    "none": logged,
    "voltage 1 row early": lambda draw: late(logged(draw), 1),
    "voltage 6 rows early": lambda draw: late(logged(draw), 6),
    "supply sags by 0.15 R": lambda draw: logged(draw, sag=0.15),
    "current 10 % too large": lambda draw: scaled(logged(draw), current=1.1),
    "current offset by 2 % of its largest": lambda draw: logged(
        draw, current={"bias": 0.02 * largest(draw)}
    ),
    "5 % of the rows missing": lambda draw: logged(draw, dropped=0.05),
    "missing rows, taken for uniform": lambda draw: uniform(logged(draw, dropped=0.05)),
    "stamps jitter by 10 %": lambda draw: logged(draw, jitter=0.1),
    "jitter, taken for uniform": lambda draw: uniform(logged(draw, jitter=0.1)),
    "0.5 % outliers of the current": lambda draw: logged(draw, current={"outliers": 0.005}),
    "0.5 % outliers of the position": lambda draw: logged(draw, position={"outliers": 0.005}),
    "0.5 % outliers of the voltage": lambda draw: spiky(logged(draw), "voltage"),
    "encoder of 512 steps": lambda draw: logged(draw, encoder=512),
    "sign of the current": lambda draw: scaled(logged(draw), current=-1.0),
    "sign of the voltage": lambda draw: scaled(logged(draw), voltage=-1.0),
    "sign of the position": lambda draw: scaled(logged(draw), position=-1.0),
    "mA for A": lambda draw: scaled(logged(draw), current=1e3),
    "degrees for radians": lambda draw: scaled(logged(draw), position=180.0 / math.pi),
    "time in ms": lambda draw: dataclasses.replace(logged(draw), time=1e3 * logged(draw).time),
    "a voltage of the rows' times, called mean": lambda draw: called(
        logged(draw, voltage="instantaneous"), True
    ),
    "a mean, called the voltage of the row": lambda draw: called(logged(draw), False),
}


def tried(make, draw):
    """Of one draw: short name -> status, relative error, whether the truth is within the interval; and what is said."""
    motor, log = motor_of(draw), make(draw)
    said = [f"{one.check} ({one.severity})" for one in check(log) if one.severity != "info"]
    try:
        found = identify([log], "free" if log.has("position") else None, seed=draw)
    except ValueError as error:
        return {}, [*said, str(error)[:40]]
    said += ["residuals" for text in found.warnings if "residuals" in text][:1]
    said += [f"{part} {rows:+g} rows" for part, rows in found.delays.items() if rows]
    named, numbers = {one.name: one for one in found.estimates}, {}
    for short, name in NAMES.items():
        if name in named:
            one, truth = named[name], _truth(motor, named, name)
            numbers[short] = one.status, one.value / truth - 1.0, one.low <= truth <= one.high
    return numbers, sorted(set(said))


def _truth(motor, named, name):
    if name == "friction_torque":  # at the speed at which the sum of both was taken
        coulomb, viscous = named["coulomb_friction"].value, named["viscous_friction"].value
        return (
            motor.coulomb_friction
            + motor.viscous_friction * (named[name].value - coulomb) / viscous
        )
    return motor.rotor_inertia if name == "inertia" else getattr(motor, name)


def cell(several):
    """Of a parameter in all draws: how many identified, of these within the interval and beyond the goal; the rough."""
    texts = []
    for status in ("identified", "rough"):
        errors = [(error, inside) for one, error, inside in several if one == status]
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
    parser.add_argument("--only", nargs="*", help="rows, by their whole names")
    options = parser.parse_args()
    rows = (
        FAULTS
        if options.faults
        else {name: lambda draw, row=row: logged(draw, **row) for name, row in ROWS.items()}
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
        found = [tried(rows[name], draw) for draw in range(options.draws)]
        cells, off = [], {}
        for short in NAMES:
            several = [numbers[short] for numbers, _ in found if short in numbers]
            cells.append(cell(several))
            if count := sum(
                one == "identified" and abs(error) > GOALS[short] for one, error, _ in several
            ):
                off[short] = count
        said = dict(collections.Counter(text for _, texts in found for text in texts))
        print(f"| {name} | {' | '.join(cells)} | {off or ''} | {said} |", flush=True)


if __name__ == "__main__":
    main()
