"""Servos in the JSON files of BAM (Better Actuator Models, github.com/Rhoban/bam).

BAM's numbers are those of the output shaft: a winding without inductance and gear, and one of six
models of friction. Its firmware computes the duty cycle `error_gain`*kp*(q* - q), as a `pwm_servo`
does.

A `pwm_servo` has no current limit. Firmware with one computes the voltage g*(q* - q), where g is
the product of voltage, `error_gain` and kp. The torque kT/R*(g*(q* - q) - kT*w) is that of a
`servo` with the velocity gain kT^2/R and the position gain g/kT, as long as the voltage suffices,
and the same voltage limits it.
"""

import math
from collections.abc import Mapping
from typing import NamedTuple

from codrl_mj.actuators.current_loop import Supply
from codrl_mj.actuators.drive import Drive
from codrl_mj.actuators.gear_motor import GearMotor
from codrl_mj.actuators.parameters import FieldValue
from codrl_mj.actuators.pwm_loop import PwmLoop
from codrl_mj.actuators.pwm_servo import PwmServo
from codrl_mj.actuators.sampled_loop import SampledLoop
from codrl_mj.actuators.servo import Servo, ServoLoop
from codrl_mj.actuators.servo_friction import ServoFriction
from codrl_mj.fields import check_names

ELECTRICAL_TIME_CONSTANT = 1e-4
"""Time constant [s] of the winding, which BAM leaves out: well below a step of simulations."""


class ServoLaw(NamedTuple):
    """Numbers of a servo's firmware and supply that BAM's package sets, and its files do not."""

    voltage: float
    """Supply voltage [V]."""
    gain: float | None
    """Position gain as the firmware's number; None: current-controlled, with a gain in each log."""
    error_gain: float = 1.0
    """Duty for a position error of 1 rad and a gain of 1."""
    max_duty: float = 1.0
    """Largest duty."""
    max_current: float = math.inf
    """Largest current [A]."""
    max_velocity: float = math.inf
    """Largest speed [rad/s] of the target."""


_MX = ServoLaw(15.0, 32.0, 0.158, 0.9625)
_EROB = ServoLaw(48.0, None, max_current=12.0)
# 4,096 counts a turn; the firmware divides by 256, and its full duty is 885.
_XL330_GAIN = 4096.0 / (2.0 * math.pi) / (256.0 * 885.0)
LAWS = {
    "mx64": _MX,
    "mx106": _MX,
    "xl320": ServoLaw(7.5, 32.0, 0.05048199),
    "xl330": ServoLaw(7.5, 400.0, _XL330_GAIN, max_current=1.75),
    # Its target moves by 3,400 counts a second.
    "sts3215": ServoLaw(7.4, 32.0, 0.166, 0.97, max_velocity=3400.0 * 2.0 * math.pi / 4096.0),
    "erob80_100": _EROB,
    "erob80_50": _EROB,
}
"""Name of an actuator in BAM -> its law, from `better-actuator-models` 1.0.2 (Apache-2.0)."""
_LAW_KEYS = {
    "vin": "voltage",
    "kp": "gain",
    "error_gain": "error_gain",
    "max_pwm": "max_duty",
    "max_velocity": "max_velocity",
}
"""Keys of a file that replace a number of the law -> its name in `ServoLaw`."""
_FRICTION_KEYS = {
    "friction_base": ("base",),
    "friction_viscous": ("viscous",),
    "friction_stribeck": ("stribeck",),
    "dtheta_stribeck": ("stribeck_speed",),
    "alpha": ("stribeck_exponent",),
    "load_friction_base": ("load_motor", "load_external"),
    "load_friction_stribeck": ("load_motor_stribeck", "load_external_stribeck"),
    "load_friction_motor": ("load_motor",),
    "load_friction_external": ("load_external",),
    "load_friction_motor_stribeck": ("load_motor_stribeck",),
    "load_friction_external_stribeck": ("load_external_stribeck",),
    "load_friction_motor_quad": ("load_motor_quadratic",),
    "load_friction_external_quad": ("load_external_quadratic",),
}
"""Keys of BAM's friction -> fields of `ServoFriction`.

The models M3 and M4 have one number for motor and load, which both fields get.
"""
_STRIBECK = ("friction_stribeck", "dtheta_stribeck", "alpha")
_DIRECTIONAL = ("load_friction_motor", "load_friction_external")
_M5 = (*_STRIBECK, *_DIRECTIONAL, *(f"{name}_stribeck" for name in _DIRECTIONAL))
_MODELS = {
    "m1": (),
    "m2": _STRIBECK,
    "m3": ("load_friction_base",),
    "m4": (*_STRIBECK, "load_friction_base", "load_friction_stribeck"),
    "m5": _M5,
    "m6": (*_M5, *(f"{name}_quad" for name in _DIRECTIONAL)),
}
"""Model -> its numbers, besides the two of `m1`, which all have."""
_OTHERS = (
    "model",
    "actuator",
    "kt",
    "R",
    "armature",
    "q_offset",
    "error_gain_ratio",
    "command_delay",
)


def is_bam(mapping: Mapping[str, FieldValue]) -> bool:
    """Return True if a file's mapping is one of BAM's, by its keys."""
    return {"model", "actuator"} <= mapping.keys() and "family" not in mapping


def bam_name(mapping: Mapping[str, FieldValue]) -> str:
    """Return a display name: actuator and model of friction."""
    return f"{mapping['actuator']}-{mapping['model']}"


def friction_from_bam(mapping: Mapping[str, FieldValue]) -> ServoFriction:
    """Return the friction of a file of BAM.

    Raises:
        ValueError: the model is unknown, or one of its numbers is missing or out of bounds.
    """
    check_names([mapping["model"]], _MODELS, "model of friction")
    keys = ("friction_base", "friction_viscous", *_MODELS[mapping["model"]])
    if missing := [key for key in keys if key not in mapping]:
        raise ValueError(f"model {mapping['model']!r}: needs {', '.join(missing)}")
    return ServoFriction(**{field: mapping[key] for key in keys for field in _FRICTION_KEYS[key]})


def bam_friction(friction: ServoFriction) -> dict[str, str | float]:
    """Return friction as BAM writes it: the first `model` of the six that suffices, and numbers."""
    values = vars(friction)

    def is_exact(model: str) -> bool:
        """Return True if the model's keys give back all numbers that have an effect."""
        read: dict[str, float] = {}
        for key in ("friction_base", "friction_viscous", *_MODELS[model]):
            read |= dict.fromkeys(_FRICTION_KEYS[key], values[_FRICTION_KEYS[key][0]])
        shape = ("stribeck_speed", "stribeck_exponent")
        return all(
            read.get(name, 0.0) == value for name, value in values.items() if name not in shape
        )

    model = next(model for model in _MODELS if is_exact(model))
    keys = ("friction_base", "friction_viscous", *_MODELS[model])
    return {"model": model} | {key: values[_FRICTION_KEYS[key][0]] for key in keys}


def from_bam(mapping: Mapping[str, FieldValue]) -> Drive | PwmServo:
    """Return the servo of a file of BAM.

    It is a `pwm_servo`; a `servo` if the firmware limits the current; a `drive` if it controls the
    current, with a gain that the file does not have. `q_offset` belongs to the bench of the logs
    and is ignored.

    Args:
        mapping: content of the file. Besides BAM's own keys it may have `vin` [V], `kp`,
            `error_gain` and `max_pwm`, which replace the values of BAM's package.

    Raises:
        ValueError: the actuator has no winding or is unknown, or a number is missing, unknown, out
            of bounds, or has no field in the actuator.
    """
    check_names(mapping, (*_OTHERS, *_LAW_KEYS, *_FRICTION_KEYS), "number of BAM's file")
    check_names([mapping["actuator"]], LAWS, "actuator of BAM", list_all=True)
    if missing := [key for key in ("kt", "R", "armature") if key not in mapping]:
        raise ValueError(
            f"{', '.join(missing)}: missing in BAM's file, whose package would take the value at"
            " which its fit starts; add it, for example R = 2 ohm for an eRob"
        )
    law = LAWS[mapping["actuator"]]._replace(
        **{name: mapping[key] for key, name in _LAW_KEYS.items() if key in mapping}
    )
    constant, resistance, delay = mapping["kt"], mapping["R"], mapping.get("command_delay", 0.0)
    motor = GearMotor(
        resistance=resistance,
        inductance=ELECTRICAL_TIME_CONSTANT * resistance,
        torque_constant=constant,
        back_emf_constant=constant,
        rotor_inertia=mapping["armature"],
    )
    friction = friction_from_bam(mapping)
    gain = (law.gain or 0.0) * law.error_gain * mapping.get("error_gain_ratio", 1.0)
    if law.gain is not None and math.isinf(law.max_current):
        duty_loop = PwmLoop(
            position_gain=gain,
            max_duty=law.max_duty,
            max_velocity=law.max_velocity,
            command_delay=delay,
        )
        return PwmServo(motor, duty_loop, Supply(law.voltage), friction=friction)
    for name, value, neutral in (
        ("command_delay", delay, 0.0),
        ("max_velocity", law.max_velocity, math.inf),
    ):
        if value != neutral:
            raise ValueError(
                f"{name} = {value:g}: BAM's {mapping['actuator']} becomes an actuator with a"
                " current limit, which has no such field; remove it from the file, and delay or"
                " limit the commands before the actuator"
            )
    parts = motor, SampledLoop(max_current=law.max_current), Supply(law.voltage * law.max_duty)
    if law.gain is None:
        return Drive(*parts, friction=friction)
    loop = ServoLoop(
        position_gain=law.voltage * gain / constant, velocity_gain=constant * constant / resistance
    )
    return Servo(*parts, loop, friction=friction)
