"""What lies between the agent's command and the joint besides the actuator: its description, and pure functions.

These are plain Python on purpose: `codrl_mj.physics.disturber` compiles them.
"""

import dataclasses
import math
import warnings
from typing import Any

import numpy as np

from codrl_mj import fields
from codrl_mj.actuators.noise import LOAD_STREAM, philox, uniform
from codrl_mj.fields import real

__all__ = ["NO_DISTURBANCES", "UNMODIFIED_JOINT", "Disturbances", "Joint", "check_delay", "resolve"]


@dataclasses.dataclass(frozen=True)
class Disturbances(fields.Checked):
    """Imperfections between the agent and its actuator, and loads on the joint; each is off at 0, its default.

    The command is the desired force [N] or torque [N*m] at the joint. On its way to the actuator it
    is first delayed, then quantised, then limited in its rate, once per integration step. Where an
    agent commands a current or a voltage, the command is the force of that current, or of as many
    amperes as volts.

    What is the actuator's own (its sensor, its supply) is described there, and what is the joint's
    (damping, friction) by the environment's `joint`.

    Raises:
        ValueError: a field is not a finite number within its bound; the message names field, value
            and bound.
    """

    command_delay: float = real(0.0, minimum=0, unit="s")
    """Delay of the command [s], >= 0; where it is no whole number of integration steps, the two
    neighbouring commands are interpolated linearly. Until the first command arrives, a position is
    held, and others are zero.
    """
    command_quantum: float = real(0.0, minimum=0, unit="N")
    """Quantisation step of the command [N or N*m], >= 0; rounds half to even, and ends at the largest force."""
    command_rate: float = real(0.0, minimum=0, unit="N/s")
    """Largest change of the command per second [N/s or N*m/s], >= 0; 0: no limit. It starts from
    zero, or from the position at the reset.
    """
    pulse_force: float = real(0.0, minimum=0, unit="N")
    """Size of random load pulses at the actuated joint [N or N*m], >= 0; either sign is as likely."""
    pulse_duration: float = real(0.0, minimum=0, unit="s")
    """Duration of a load pulse [s], > 0 where there are pulses."""
    pulse_interval: float = real(0.0, minimum=0, unit="s")
    """Mean time [s] from the start, and from the end of each pulse, to the next; exponentially
    distributed. > 0 where there are pulses.
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
        """Whether an episode needs a key for its random numbers."""
        return bool(self.pulse_force)


NO_DISTURBANCES = Disturbances()
"""No disturbances."""


@dataclasses.dataclass(frozen=True)
class Joint(fields.Checked):
    """What is added to the actuated joints of the model; nothing by default. MuJoCo physics only.

    Raises:
        ValueError: a field is not a finite number within its bound; the message names field, value
            and bound.
    """

    damping: float = real(0.0, minimum=0, unit="N*s/m")
    """Viscous friction [N*s/m or N*m*s/rad], >= 0."""
    friction: float = real(0.0, minimum=0, unit="N")
    """Coulomb friction [N or N*m], >= 0."""
    armature: float = real(0.0, minimum=0, unit="kg")
    """Inertia [kg or kg*m^2], >= 0, such as a rotor's behind a gear."""


UNMODIFIED_JOINT = Joint()
"""Nothing added."""


def resolve(given: Any, absent: Any) -> Any:
    """What a user wrote for `Disturbances` or for a `Joint`: one, or a mapping of its fields; None is for `absent`.

    Args:
        given: what was written.
        absent: `OFF` or `PLAIN`.

    Raises:
        ValueError: an unknown field (the nearest known one is suggested) or a value out of bounds.
    """
    if given is None or isinstance(given, type(absent)):
        return absent if given is None else given
    return fields.build(type(absent), given, "field", f"{type(absent).__name__.lower()}.")


def check_delay(disturbances: Disturbances, step_duration: float, max_steps: int | None) -> None:
    """Refuse a delay [s] as long as an episode, in which no command arrives; warn of one over twenty of its steps.

    Args:
        disturbances: with the delay.
        step_duration: of an environment step [s].
        max_steps: the longest episode [environment steps]; None if it is not known.
    """
    delay, episode = (
        disturbances.command_delay,
        math.inf if max_steps is None else max_steps * step_duration,
    )
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


_NEAR = 1e-9  # of an integration step: nearer to a whole number of steps is that number


def whole_and_fraction(delay: float, timestep: float) -> tuple[int, float]:
    """A delay [s] in integration steps [s]: the whole number below it, and the rest in [0, 1)."""
    steps = delay / timestep
    nearest = round(steps)
    if abs(steps - nearest) <= _NEAR * max(1.0, steps):
        return nearest, 0.0
    return math.floor(steps), steps - math.floor(steps)


def interpolate_delayed(newer: float, older: float, fraction: float) -> float:
    """The command [N or N*m] between two that were given a step apart, `fraction` in [0, 1] of it towards the older."""
    return newer + fraction * (older - newer)


def quantize(command: float, quantum: float, limit: float) -> float:
    """The nearest multiple of the quantum, half to even, within +-limit, all in [N or N*m]."""
    return np.minimum(np.maximum(quantum * np.rint(command / quantum), -limit), limit)


def limit_rate(command: float, before: float, change: float) -> float:
    """The command, at most `change` away from that of the integration step before, all in [N or N*m]."""
    return np.minimum(np.maximum(command, before - change), before + change)


PULSE_NAMES = ("key", "step", "index", "start")
"""What the memory of an environment's pulses holds: the key of the random numbers, integration
steps since the start of the episode, number of the present or next pulse, and when that one starts
[s].
"""
KEY, STEP, INDEX, START = range(len(PULSE_NAMES))


def pulse_load(
    memory: np.ndarray, timestep: float, force: float, duration: float, interval: float
) -> float:
    """The mean load [N or N*m] over an environment's next integration step; moves the memory on by that step.

    A pulse that covers part of a step counts in proportion, so that its impulse does not depend on
    the step.
    """
    key, step = int(memory[KEY]), memory[STEP]
    begin, end = step * timestep, (step + 1.0) * timestep
    w0, w1, sign, _ = philox(int(memory[INDEX]), 0, 0, LOAD_STREAM, key)
    if step == 0.0:
        memory[START] = -interval * math.log(uniform(w0, w1))
    load = 0.0
    while memory[START] < end:
        last = memory[START] + duration
        covered = max(min(last, end) - max(memory[START], begin), 0.0) / timestep
        load += min(covered, 1.0) * (force if sign & 1 else -force)
        if last > end:
            break
        memory[INDEX] += 1.0
        w0, w1, sign, _ = philox(int(memory[INDEX]), 0, 0, LOAD_STREAM, key)
        memory[START] = last - interval * math.log(uniform(w0, w1))
    memory[STEP] = step + 1.0
    return load
