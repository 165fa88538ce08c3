"""Made-up rows of every arm, in which the claims of a source are true."""

from pathlib import Path

import numpy as np

from reproduction.arms import ARMS
from reproduction.rows import COLUMNS, Trained

SPREAD = np.array([-1.0, 0.0, 1.0, 0.5, -0.5])
"""Offsets of five seeds around the given values."""


def made_up(
    arm,
    seed=0,
    last=0.0,
    test=0.0,
    success=1.0,
    tracking=1.0,
    largest=0.05,
    time=50.0,
    centre=0.96,
    epoch=33,
):
    """Return a row with given results.

    Args:
        arm: arm of the row.
        seed: seed that shifts returns, times and epochs slightly from the given values.
        last: mean return of the last training episodes.
        test: return of the test.
        success: share of the test episodes that succeed.
        tracking: rms torque error [%].
        largest: largest torque error [N*m].
        time: median time to the goal [s]; the episodes' are up to 20 % away from it.
        centre: share of steps near the center.
        epoch: the epoch from which on episodes last 4000 steps and earn as many rewards.
    """
    shift = SPREAD[seed]
    times = time * np.linspace(0.8, 1.2, 41) + shift
    arrived = round(success * len(times))
    row = {name: getattr(arm, name) for name in ("task", "settings", "motor", "gains", "physics")}
    row |= {"seed": seed, "run": "nowhere", "seconds": 60.0, "last_50": last + shift}
    row |= {
        "returns": test + 0.5 * shift if test != 500 else 500.0,
        "success": success,
        "upright": success,
    }
    row |= {"tracking_percent": tracking, "tracking_max": largest, "centred": centre}
    row |= {"tracking_step_percent": tracking}
    row |= {
        "time_to_goal": float(np.median(times)),
        "times": " ".join([*map(str, times[:arrived]), *"-" * (41 - arrived)]),
    }
    row |= dict.fromkeys(("long_epoch", "paid_epoch"), int(epoch + 2 * shift))
    return {name: str(row.get(name, "")) for name in COLUMNS}


def trained(seed=0, epoch=35):
    """Return a run whose episodes last 4000 steps, and earn 4000, from an epoch on."""
    first = int(epoch + 2 * SPREAD[seed])
    short = [[0, 4000 * (n + k / 10), 390.0, 400] for n in range(first - 1) for k in range(1, 11)]
    long = [[0, 4000 * n, 3990.0, 4000] for n in range(first, 61)]
    return Trained(Path("nowhere"), np.array(short + long), {}, 60.0)


def world(values, seeds=range(5)):
    """Return the rows of every arm by name.

    Args:
        values: (task, settings, motor) -> arguments of `made_up`; each arm takes those of its task,
            settings and motor.
        seeds: number of seeds of every arm.
    """
    return {
        arm.name: [made_up(arm, n, **values[arm.task, arm.settings, arm.motor]) for n in seeds]
        for arm in ARMS
    }


PAPERS = {
    **{
        ("pendulum", settings, motor): {"last": -150, "test": -150, "tracking": 1.0}
        for settings in ("paper", "repaired")
        for motor in ("paper gains", "ideal")
    },
    ("mountain_car", "paper", "paper gains"): {
        "last": -114,
        "test": -85,
        "tracking": 40.0,
        "time": 85.0,
    },
    ("mountain_car", "paper", "fast gains"): {
        "last": -120,
        "test": -100,
        "tracking": 1.0,
        "time": 100.0,
    },
    ("mountain_car", "paper", "ideal"): {"last": -150, "test": -160, "time": 160.0},
    **{
        ("mountain_car_continuous", settings, motor): {"last": 95, "test": 95, "time": 75.0}
        for settings in ("paper", "repaired")
        for motor in ("paper gains", "ideal")
    },
    **{
        ("acrobot", "paper", motor): {"last": -200, "test": -125, "time": 25.0, "tracking": 10.0}
        for motor in ("paper gains", "ideal")
    },
    **{
        ("cartpole", "paper", motor): {"test": 500, "epoch": 33, "largest": 0.09}
        for motor in ("paper gains", "ideal")
    },
}
"""Values that the paper reports."""

OTHERS = PAPERS | {
    ("pendulum", "paper", "paper gains"): {"last": -1400, "test": -1413, "success": 0.0},
    ("pendulum", "paper", "ideal"): {"last": -1400, "test": -1413, "success": 0.0},
    ("pendulum", "repaired", "paper gains"): {"last": -160, "test": -150, "time": 1.7},
    ("mountain_car", "paper", "paper gains"): {
        "last": -122.5,
        "test": -120,
        "tracking": 40.0,
        "time": 120.0,
    },
    ("mountain_car", "paper", "fast gains"): {
        "last": -117.7,
        "test": -115,
        "tracking": 20.0,
        "time": 115.0,
    },
    ("mountain_car", "paper", "ideal"): {"last": -118.5, "test": -115, "time": 115.0},
    ("mountain_car_continuous", "paper", "paper gains"): {
        "last": -99.9,
        "test": -99.9,
        "success": 0.0,
    },
    ("mountain_car_continuous", "paper", "ideal"): {"last": -99.9, "test": -99.9, "success": 0.0},
    ("mountain_car_continuous", "repaired", "paper gains"): {"last": 92, "test": 92, "time": 80.0},
    ("mountain_car_continuous", "repaired", "ideal"): {"last": 92, "test": 92, "time": 80.0},
    ("acrobot", "paper", "paper gains"): {
        "last": -90,
        "test": -81,
        "success": 0.9,
        "time": 16.0,
        "tracking": 30.0,
    },
    ("acrobot", "paper", "ideal"): {"last": -90, "test": -81, "time": 16.0},
    ("cartpole", "paper", "paper gains"): {"test": 500, "epoch": 40, "largest": 0.119},
}
"""Values that contradict many of the claims."""
