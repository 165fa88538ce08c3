"""The motor as it runs inside MuJoCo, callbacks and all, against oracles that are not ours.

`motor_loops` has the current loop against linear systems theory, `motor_windings` the motor under a voltage against
MuJoCo's `<dcmotor>`, gym-electric-motor and a datasheet, `in_python` what can be asked of any family of actuators,
`drives` what bench motors are compared with. Torques are read where the engine applies them.
"""

import importlib.util
from collections.abc import Iterator

from codrl_mj.actuators import Motor
from codrl_mj.validation.drives import drive_checks
from codrl_mj.validation.in_python import compiled_checks
from codrl_mj.validation.motor_loops import analogue, sampled_checks
from codrl_mj.validation.motor_windings import MOTORS, constants_checks, gem_check, native_checks
from codrl_mj.validation.rotors import Loop, standard_loops
from codrl_mj.validation.table import Check


def available() -> bool:
    """Whether gym-electric-motor is installed."""
    return importlib.util.find_spec("gym_electric_motor") is not None


def checks(task_name: str | None = None, quick: bool = False) -> Iterator[Check]:
    """The checks of the motor, with the loop of one task alone, or with every task's and one with every feature."""
    loops = standard_loops()
    yield from checks_of(loops if task_name is None else {task_name: loops[task_name]}, quick)
    yield from compiled_checks(quick)
    yield from drive_checks(quick)
    yield from native_checks(MOTORS, quick)
    if available():
        yield from gem_check(Motor(), quick)


def checks_of(loops: dict[str, Loop], quick: bool = False) -> Iterator[Check]:
    """Those checks that apply to any motors, such as a user's own: all but the comparisons with fixed motors."""
    yield from analogue(loops, quick)
    yield from sampled_checks(loops, quick)
    yield from constants_checks(loops)
