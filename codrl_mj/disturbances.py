"""Disturbances between the agent's command and the joint: their settings, and pure functions.

The functions are plain Python on purpose: `codrl_mj.physics.disturber` compiles them.
"""

import dataclasses
import math
import warnings
from typing import TypeVar

import numpy as np

from codrl_mj import fields
from codrl_mj.actuators.noise import LOAD_STREAM, philox, uniform
from codrl_mj.fields import real

__all__ = ["NO_DISTURBANCES", "UNMODIFIED_JOINT", "Disturbances", "Joint", "check_delay", "resolve"]


@dataclasses.dataclass(frozen=True)
class Disturbances(fields.Checked):
    """Disturbances of the agent's command and loads on the joint; each is off at 0, its default.

    The command is the desired force [N] or torque [N*m] at the joint. Before it reaches the
    actuator it is first delayed, then quantized, then limited in its rate, once per integration
    step. If an agent commands a current or a voltage, the command is the force of that current, or
    of as many amperes as volts.

    The actuator's sensor and supply are settings of the actuator. Damping and friction of the joint
    are settings of the environment's `joint`.

    Raises:
        ValueError: a field is not a finite number within its bound; the message names field, value
            and bound.
    """

    command_delay: float = real(0.0, minimum=0, unit="s")
    """Delay of the command [s], >= 0. If it is not a whole number of integration steps, the two
    adjacent commands are interpolated linearly. Until the first command arrives, the joint's
    position is held if commands are positions; other commands are zero.
    """
    command_quantum: float = real(0.0, minimum=0, unit="N")
    """Quantization step of the command [N or N*m], >= 0; rounds half to even, up to the largest
    force.
    """
    command_rate: float = real(0.0, minimum=0, unit="N/s")
    """Largest change of the command per second [N/s or N*m/s], >= 0; 0: no limit. It starts from
    zero, or from the position at the reset.
    """
    pulse_force: float = real(0.0, minimum=0, unit="N")
    """Size of random load pulses at the actuated joint [N or N*m], >= 0; both signs are equally
    likely.
    """
    pulse_duration: float = real(0.0, minimum=0, unit="s")
    """Duration of a load pulse [s], > 0 if there are pulses."""
    pulse_interval: float = real(0.0, minimum=0, unit="s")
    """Mean time [s] from the start of the episode, and from the end of each pulse, to the next
    pulse; exponentially distributed. > 0 if there are pulses.
    """

    def __post_init__(self) -> None:
        """Validate."""
        super().__post_init__()
        for name in ("pulse_duration", "pulse_interval"):
            value = getattr(self, name)
            if self.pulse_force and not value:
                raise ValueError(
                    f"Disturbances.{name} = {value:g}: must be a finite number > 0 where there are"
                    " pulses"
                )
            if value and not self.pulse_force:
                raise ValueError(
                    f"Disturbances.{name} = {value:g}: there are no pulses: give pulse_force > 0"
                )

    @property
    def random(self) -> bool:
        """True if an episode needs a key for random numbers."""
        return bool(self.pulse_force)


NO_DISTURBANCES = Disturbances()
"""Settings without disturbances."""


@dataclasses.dataclass(frozen=True)
class Joint(fields.Checked):
    """Quantities added to the actuated joints of the model; all 0 by default. MuJoCo physics only.

    Raises:
        ValueError: a field is not a finite number within its bound; the message names field, value
            and bound.
    """

    damping: float = real(0.0, minimum=0, unit="N*s/m")
    """Viscous friction [N*s/m or N*m*s/rad], >= 0."""
    friction: float = real(0.0, minimum=0, unit="N")
    """Coulomb friction [N or N*m], >= 0."""
    armature: float = real(0.0, minimum=0, unit="kg")
    """Inertia [kg or kg*m^2], >= 0, for example of a rotor behind a gear."""


UNMODIFIED_JOINT = Joint()
"""Settings of a joint to which nothing is added."""
Settings = TypeVar("Settings", Disturbances, Joint)
"""Disturbances or a joint."""


def resolve(value: object, default: Settings) -> Settings:
    """Return a user's setting as `Disturbances` or `Joint`.

    Args:
        value: an instance, a mapping of its fields, or None for the default.
        default: `NO_DISTURBANCES` or `UNMODIFIED_JOINT`.

    Raises:
        ValueError: an unknown field (the message suggests the nearest one) or a value out of
            bounds.
    """
    if value is None or isinstance(value, type(default)):
        return default if value is None else value
    return fields.build(type(default), value, "field", f"{type(default).__name__.lower()}.")


def check_delay(disturbances: Disturbances, step_duration: float, max_steps: int | None) -> None:
    """Raise if a delay [s] exceeds the episode; warn if it exceeds twenty environment steps.

    Args:
        disturbances: settings with the delay.
        step_duration: duration of an environment step [s].
        max_steps: length of the longest episode [environment steps]; None if unknown.
    """
    delay = disturbances.command_delay
    episode = math.inf if max_steps is None else max_steps * step_duration
    text = f"Disturbances.command_delay = {delay:g}: "
    remedy = f"it is in seconds: for {delay:g} ms write {delay / 1e3:g}"
    if delay >= episode:
        raise ValueError(
            f"{text}must be < {episode:g} s, the longest episode, or no command would arrive;"
            f" {remedy}"
        )
    if delay > 20.0 * step_duration:
        warnings.warn(
            f"{text}a delay of {delay / step_duration:.3g} environment steps; {remedy}",
            stacklevel=2,
        )


# A delay that is closer than this to a whole number of integration steps counts as that number.
_WHOLE_STEP_TOLERANCE = 1e-9


def whole_and_fraction(delay: float, timestep: float) -> tuple[int, float]:
    """Return a delay [s] in integration steps [s]: whole number and remainder in [0, 1)."""
    steps = delay / timestep
    nearest = round(steps)
    if abs(steps - nearest) <= _WHOLE_STEP_TOLERANCE * max(1.0, steps):
        return nearest, 0.0
    return math.floor(steps), steps - math.floor(steps)


def interpolate_delayed(newer: float, older: float, fraction: float) -> float:
    """Return the command [N or N*m] between two consecutive ones; `fraction` 1 is the older."""
    return newer + fraction * (older - newer)


def quantize(command: float, quantum: float, limit: float) -> float:
    """Return the nearest multiple of the quantum, half to even, within +-limit, in [N or N*m]."""
    rounded: float = np.minimum(np.maximum(quantum * np.rint(command / quantum), -limit), limit)
    return rounded


def limit_rate(command: float, before: float, change: float) -> float:
    """Return the command within `change` of the previous step's command, all in [N or N*m]."""
    limited: float = np.minimum(np.maximum(command, before - change), before + change)
    return limited


PULSE_NAMES = ("key", "step", "index", "start")
"""Entries of the memory of an environment's pulses: key of the random numbers, integration steps
since the start of the episode, number of the present or next pulse, and its start [s].
"""
KEY, STEP, INDEX, START = range(len(PULSE_NAMES))


def pulse_load(
    memory: np.ndarray, timestep: float, force: float, duration: float, interval: float
) -> float:
    """Return the mean load [N or N*m] over the next integration step, and advance the memory.

    A pulse that covers part of a step counts in proportion, so that its impulse does not depend on
    the step.
    """
    key, step = int(memory[KEY]), memory[STEP]
    begin, end = step * timestep, (step + 1.0) * timestep
    # Times between pulses are exponential. The first pulse is drawn at the first step, because a
    # reset only clears the memory.
    w0, w1, sign, _ = philox(int(memory[INDEX]), 0, 0, LOAD_STREAM, key)
    if step == 0.0:
        memory[START] = -interval * math.log(uniform(w0, w1))
    load = 0.0
    while memory[START] < end:
        pulse_end = memory[START] + duration
        covered = max(min(pulse_end, end) - max(memory[START], begin), 0.0) / timestep
        load += min(covered, 1.0) * (force if sign & 1 else -force)
        if pulse_end > end:
            break
        memory[INDEX] += 1.0
        w0, w1, sign, _ = philox(int(memory[INDEX]), 0, 0, LOAD_STREAM, key)
        memory[START] = pulse_end - interval * math.log(uniform(w0, w1))
    memory[STEP] = step + 1.0
    return load
