"""The actuator's parameters: a DC motor, its current loop, and the two together.

Every class is frozen and validated when it is made, so an `Actuator` that exists is one that can be
simulated; whether its loop is *stable* depends on the time step and is checked by
`codrl_mj.motor.stability`.

Source of the equations and of the defaults: *Control-Optimized Deep Reinforcement Learning*
(arXiv 2507.00268), Methodology; "the paper" below.
"""

import dataclasses
import difflib
import math
import numbers
from collections.abc import Mapping, Sequence
from typing import Any

_FINITE = "a finite number"


def _check(owner: object, field: str, *, above: float | None = None, least: float | None = None) -> None:
    """Store `field` of the frozen `owner` as a float, or raise `ValueError` naming field, value and bound."""
    value = getattr(owner, field)
    bound = f"> {above:g}" if above is not None else f">= {least:g}"
    name = f"{type(owner).__name__}.{field}"
    if isinstance(value, bool) or not isinstance(value, numbers.Real):
        raise ValueError(f"{name} = {value!r}: must be a number {bound}")
    number = float(value)
    infinite_is_fine = field == "max_voltage"
    if math.isnan(number) or (math.isinf(number) and not infinite_is_fine):
        raise ValueError(f"{name} = {number}: must be {_FINITE} {bound}")
    if (above is not None and not number > above) or (least is not None and not number >= least):
        raise ValueError(f"{name} = {number:g}: must be {bound}")
    object.__setattr__(owner, field, number)


@dataclasses.dataclass(frozen=True)
class Motor:
    """A brushed DC motor: a winding (R, L) whose current makes torque and whose speed makes voltage.

    L di/dt = u - kE*omega - R*i and torque = kT*i (the paper, eqs. for the current update and the torque).

    Raises:
        ValueError: a field is not a finite number within its bound; the message names field, value and bound.
    """

    resistance: float = 1.0
    """Winding resistance R [ohm], > 0. The paper: 1, all tasks."""
    inductance: float = 0.1
    """Winding inductance L [H], > 0. The paper: 0.1, all tasks."""
    torque_constant: float = 1.0
    """Torque constant kT [N*m/A], > 0. The paper: 1, all tasks."""
    back_emf_constant: float = 1.0
    """Back-EMF constant kE [V*s/rad], >= 0; equal to kT in SI units for an ideal motor. The paper: 1."""
    arm_radius: float = 1.0
    """Arm r [m] between shaft and load, > 0: torque = r*F and omega = v/r. On a hinge it is the inverse of the
    gear ratio (no unit). The paper: 0.15 for CartPole, else 1."""

    def __post_init__(self) -> None:
        """Validate."""
        for field in ("resistance", "inductance", "torque_constant", "arm_radius"):
            _check(self, field, above=0.0)
        _check(self, "back_emf_constant", least=0.0)

    @property
    def electrical_time_constant(self) -> float:
        """L/R [s]: how fast the current would follow a voltage step with no loop around it."""
        return self.inductance / self.resistance


@dataclasses.dataclass(frozen=True)
class CurrentLoop:
    """The PID loop that chooses the motor's terminal voltage from desired and measured current.

    u = sat(kp*e + ki*I + kd*D + kff*i_ref + kE*omega, +-max_voltage), with e = i_ref - i.

    Raises:
        ValueError: a field is not a finite number within its bound; the message names field, value and bound.
    """

    kp: float = 1.0
    """Proportional gain [V/A], >= 0."""
    ki: float = 0.0
    """Integral gain [V/(A*s)], >= 0."""
    kd: float = 0.0
    """Derivative gain [V*s/A], >= 0."""
    kff: float = 0.0
    """Feed-forward gain on the reference current [V/A], >= 0; kff = R holds the current without feedback."""
    max_voltage: float = 24.0
    """Supply limit u_max [V], > 0; `inf` for none. The paper gives no value: 24 V never saturates at its settings."""
    bemf_compensation: bool = True
    """Add kE*omega to the voltage, which cancels the back-EMF unless the voltage saturates. The paper: yes."""
    substeps: int = 1
    """Electrical steps within one mechanical step, >= 1: for winding time constants below the mechanical step."""
    integral_leak: float = 0.0
    """Leak rate of the integral [1/s], >= 0: the paper appendix's low-pass form of the integral. 0: a plain sum."""
    derivative_time_constant: float = 0.0
    """Time constant [s] of the low-pass on the derivative, >= 0: the appendix's high-pass form of the derivative.
    0: the plain difference of two samples."""

    def __post_init__(self) -> None:
        """Validate."""
        for field in ("kp", "ki", "kd", "kff", "integral_leak", "derivative_time_constant"):
            _check(self, field, least=0.0)
        _check(self, "max_voltage", above=0.0)
        if not isinstance(self.bemf_compensation, bool):
            raise ValueError(f"CurrentLoop.bemf_compensation = {self.bemf_compensation!r}: must be True or False")
        if isinstance(self.substeps, bool) or not isinstance(self.substeps, numbers.Integral) or self.substeps < 1:
            raise ValueError(f"CurrentLoop.substeps = {self.substeps!r}: must be an integer >= 1")
        object.__setattr__(self, "substeps", int(self.substeps))


@dataclasses.dataclass(frozen=True)
class Actuator:
    """A motor and the current loop that drives it: what stands between a desired force and the force delivered."""

    motor: Motor = Motor()
    """The motor and its arm."""
    controller: CurrentLoop = CurrentLoop()
    """The current loop."""

    def __post_init__(self) -> None:
        """Validate."""
        for field, kind in (("motor", Motor), ("controller", CurrentLoop)):
            if not isinstance(getattr(self, field), kind):
                raise ValueError(
                    f"Actuator.{field} = {getattr(self, field)!r}: must be a {kind.__name__}; "
                    "to build an actuator from nested mappings use Actuator.from_mapping"
                )

    @classmethod
    def from_mapping(cls, mapping: Mapping[str, Any]) -> "Actuator":
        """Build an actuator from nested mappings; absent fields take the dataclasses' defaults.

        Args:
            mapping: for example `{"motor": {"inductance": 0.2}, "controller": {"kp": 2.0}}`.

        Raises:
            ValueError: an unknown field (the nearest known one is suggested) or a value out of bounds.
        """
        return _from_mapping(cls, mapping, "")

    def as_mapping(self) -> dict[str, dict[str, Any]]:
        """The nested mapping that `from_mapping` reads; JSON-serialisable while `max_voltage` is finite."""
        return dataclasses.asdict(self)


def _from_mapping(cls: type, mapping: object, path: str) -> Any:
    """Build the dataclass `cls` from `mapping`, naming the dotted `path` of whatever is wrong."""
    if not isinstance(mapping, Mapping):
        raise ValueError(
            f"actuator field {path.rstrip('.')!r} = {mapping!r}: must be a mapping of {cls.__name__}'s fields"
        )
    fields = {field.name: field for field in dataclasses.fields(cls)}
    for key in mapping:
        if key not in fields:
            near = difflib.get_close_matches(str(key), fields, n=1)
            hint = f"; did you mean {path}{near[0]}?" if near else f"; known fields: {', '.join(fields)}"
            raise ValueError(f"unknown actuator field {path}{key}{hint}")
    nested = {"motor": Motor, "controller": CurrentLoop}
    return cls(
        **{
            key: _from_mapping(nested[key], value, f"{path}{key}.") if key in nested else value
            for key, value in mapping.items()
        }
    )


# -- The parameter vector -----------------------------------------------------------------------------------
# One layout serves the mathematics (current_loop.py) and the MJCF actuator's `user` data.

SIGNATURE = 2507.00268
"""First number of the `user` data of every actuator that is ours: the paper's arXiv identifier."""

_MOTOR_FIELDS = ("resistance", "inductance", "torque_constant", "back_emf_constant")
_LOOP_FIELDS = tuple(field.name for field in dataclasses.fields(CurrentLoop))
PARAMETER_NAMES = ("signature", *_MOTOR_FIELDS, *_LOOP_FIELDS)
"""Names of the parameter vector's entries, in order. The arm is not among them: in the MJCF it is gear = 1/r."""

(
    _,
    RESISTANCE,
    INDUCTANCE,
    TORQUE_CONSTANT,
    BACK_EMF_CONSTANT,
    KP,
    KI,
    KD,
    KFF,
    MAX_VOLTAGE,
    BEMF_COMPENSATION,
    SUBSTEPS,
    INTEGRAL_LEAK,
    DERIVATIVE_TIME_CONSTANT,
) = range(len(PARAMETER_NAMES))

IMPERFECTION_NAMES = ("current_bias", "current_noise", "supply_resistance")
"""Names of what follows the parameter vector in the `user` data of an actuator with an imperfect sensor or supply."""

CURRENT_BIAS, CURRENT_NOISE, SUPPLY_RESISTANCE = range(
    len(PARAMETER_NAMES), len(PARAMETER_NAMES) + len(IMPERFECTION_NAMES)
)


def to_vector(actuator: Actuator) -> list[float]:
    """The actuator as a parameter vector: the MJCF actuator's `user` data, entries as in `PARAMETER_NAMES`."""
    motor = [getattr(actuator.motor, field) for field in _MOTOR_FIELDS]
    loop = [float(getattr(actuator.controller, field)) for field in _LOOP_FIELDS]
    return [SIGNATURE, *motor, *loop]


def from_vector(vector: Sequence[float], arm_radius: float) -> Actuator:
    """The actuator that a parameter vector (and the arm, kept in the MJCF's gear) describes.

    Raises:
        ValueError: the vector is not one of ours, or holds a value out of bounds.
    """
    if len(vector) < len(PARAMETER_NAMES) or vector[0] != SIGNATURE:
        raise ValueError(
            f"actuator user data {list(vector)}: must hold {len(PARAMETER_NAMES)} numbers, the first {SIGNATURE}; "
            f"they are {', '.join(PARAMETER_NAMES)}"
        )
    values: dict[str, Any] = dict(zip(PARAMETER_NAMES, map(float, vector), strict=False))
    for flag, kind in (("bemf_compensation", bool), ("substeps", int)):
        if not math.isfinite(values[flag]) or values[flag] != kind(values[flag]):
            raise ValueError(f"CurrentLoop.{flag} = {values[flag]:g}: must be a whole {kind.__name__}")
        values[flag] = kind(values[flag])
    return Actuator(
        Motor(**{field: values[field] for field in _MOTOR_FIELDS}, arm_radius=arm_radius),
        CurrentLoop(**{field: values[field] for field in _LOOP_FIELDS}),
    )
