"""Losses of a motor in the notation of another simulator: fields, torque and motion.

Torque and motion are compared to a model of the written motor: a torque-speed line, the steady
winding of BAM, or MuJoCo's own `<dcmotor>`.
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from codrl_mj.actuators import ActuatorModel, Drive, Inputs, TorqueSpeed, parameters_type
from codrl_mj.actuators.model import FamilyTuple
from codrl_mj.actuators.parameters import choices_of, value_at
from codrl_mj.actuators.servo_friction import LOAD_TERMS
from codrl_mj.arrays.array_code import advance
from codrl_mj.arrays.written_models import (
    bam_motor_torque,
    bam_torque,
    dcmotor_element,
    friction_of,
    torque_speed_line,
    winding_of,
    winding_torque,
)

Law = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Steady torque at the joint for a desired torque and a speed."""
Stepper = Callable[[float, float, float], float]
"""Torque at the joint over a step, for a desired torque, a speed and the time."""
NUM_POINTS = 60
"""Number of speeds, and of torques, at which torques are compared; even, so that 0 is not one."""
OVERRANGE = 1.2
"""Largest speed and desired torque that are compared, in no-load speeds and stall torques."""
COMMAND_FREQUENCY = 2.0
"""Frequency [Hz] of the command in the test motion."""
_HELD = 1e12
"""Inertia [kg*m^2] at the shaft of a motor whose speed is held."""
RISE_TIME = 0.1
"""Time [s] in which the stall torque would bring the load of the test motion to no-load speed."""


class LostField(NamedTuple):
    """Fields of a motor that have no place in another notation."""

    fields: tuple[str, ...]
    """Their paths."""
    values: tuple[float | str, ...]
    """Their values; flags as numbers."""
    effect: str
    """Consequence."""


class WrittenComparison(NamedTuple):
    """Difference between a motor and its model in another simulator."""

    torque_error: float
    """Largest error [N*m] of the steady torque, or force [N], at the joint.

    Compared are 60 speeds up to 1.2 times the no-load speed, in both directions, with 60 desired
    torques up to 1.2 times the stall torque, at ambient temperature.
    """
    stall_torque: float
    """Stall torque [N*m], or force [N], at the joint."""
    error_speed: float
    """Speed [rad/s, m/s] of the largest error."""
    error_torque: float
    """Desired torque [N*m], or force [N], of the largest error."""
    motion_gap: float
    """Largest difference [rad, m] of the positions in the test motion.

    The desired torque is a cosine of 2 Hz as large as the largest torque, for 1 s. The load has the
    inertia that the stall torque would bring to no-load speed in 0.1 s. The friction that both
    simulators give to the joint is left out.
    """
    motion_range: float
    """Range [rad, m] of our motor's positions in the test motion."""


class _Place(NamedTuple):
    """Fields of a drive, and the targets that have a place for them."""

    fields: tuple[str, ...]
    effect: str
    targets: tuple[str, ...] = ()
    neutral: Sequence[float] = ()
    """Values of the first field at which the fields have no effect."""


def _of(part: str, *names: str) -> tuple[str, ...]:
    return tuple(f"{part}.{name}" for name in names)


_LINES = ("mjlab", "isaaclab", "newton")
_EVERYWHERE = (*_LINES, "dcmotor", "bam")
_PLACES = (
    _Place(_of("motor", "torque_constant", "back_emf_constant", "resistance"), "", _EVERYWHERE),
    _Place(_of("motor", "gear_ratio", "arm_radius", "ambient_temperature"), "", _EVERYWHERE),
    _Place(_of("motor", "rotor_inertia", "viscous_friction", "coulomb_friction"), "", _EVERYWHERE),
    _Place(("controller.deadband",), "", _EVERYWHERE),
    # BAM's file has no place for these two, but what to set instead is computed for each motor.
    _Place(("supply.voltage", "controller.max_current"), "", _EVERYWHERE),
    _Place(
        ("supply.resistance",),
        "added to the winding, also when it brakes",
        neutral=[0.0],
    ),
    _Place(("motor.inductance",), "the torque is immediate", ("dcmotor",)),
    _Place(
        _of("controller", "sample_rate", "bandwidth", "kp", "ki", "anti_windup", "delayed"),
        "no current loop: the torque is immediate",
    ),
    _Place(
        ("controller.bemf_compensation",),
        "no current loop: the speed does not disturb the torque",
        neutral=[1.0],
    ),
    # No target has a place for the gear's efficiency, but the effects differ.
    _Place(
        ("motor.gear_efficiency",),
        "only limits have losses, those of a driving gear",
        ("dcmotor", "bam"),
        [1.0],
    ),
    _Place(("motor.gear_efficiency",), "the gear loses no torque", (*_LINES, "bam"), [1.0]),
    _Place(
        ("motor.gear_efficiency",),
        "braking has the losses of driving",
        (*_LINES, "dcmotor"),
        [1.0],
    ),
    _Place(
        _of("motor", "stribeck_friction", "stribeck_speed", "stribeck_exponent"),
        "no friction that decreases with the speed",
        ("bam",),
        [0.0],
    ),
    _Place(_of("friction", "base", "viscous"), "", _EVERYWHERE),
    _Place(
        _of("friction", "stribeck", "stribeck_speed", "stribeck_exponent"),
        "no friction that decreases with the speed",
        ("bam",),
        [0.0],
    ),
    *(
        _Place((f"friction.{name}",), "no friction that grows with torques", ("bam",), [0.0])
        for name in LOAD_TERMS
    ),
    _Place(("motor.load_inertia",), "the speed is not predicted within a step", neutral=[0.0]),
    _Place(
        ("motor.max_temperature",),
        "the temperature has no limit",
        neutral=[math.inf],
    ),
)
_THERMAL = _of(
    "motor",
    *("thermal_resistance_winding", "thermal_time_constant_winding"),
    *("thermal_resistance_housing", "thermal_time_constant_housing", "resistance_coefficient"),
)


def lost_fields(drive: Drive, target: str) -> tuple[LostField, ...]:
    """Return the fields of a drive that have an effect, but no place in a notation."""

    def lost(fields: tuple[str, ...], effect: str) -> LostField:
        return LostField(fields, tuple(_value(drive, path) for path in fields), effect)

    rows = [
        lost(row.fields, row.effect)
        for row in _PLACES
        if target not in row.targets and value_at(drive, row.fields[0]) not in row.neutral
    ]
    motor = drive.motor
    if target == "bam":
        winding = winding_of(drive, target)
        # Without this, BAM has the supply of the MX-106 that the file names, and 96 % of its duty.
        effect = f"set actuator.vin = {winding.voltage:.6g} and max_pwm = 1 of the loaded model"
        rows.append(lost(("supply.voltage",), effect))
        if math.isfinite(winding.max_current):
            effect = f"set actuator.max_current = {winding.max_current:.6g} of the loaded model"
            rows.append(lost(("controller.max_current",), effect))
    if target not in _LINES and motor.torque_constant != motor.back_emf_constant:
        share = motor.torque_constant / motor.back_emf_constant
        effect = f"torques are kept; currents are {share:.4g} of the motor's"
        rows.append(lost(("motor.torque_constant",), effect))
    resistances = motor.thermal_resistance_winding, motor.thermal_resistance_housing
    if target == "dcmotor" and min(resistances) > 0.0:
        rows.append(lost(_THERMAL[:4], "one thermal body: it warms too slowly at first"))
    elif target != "dcmotor" and max(resistances) > 0.0:
        rows.append(lost(_THERMAL, "the motor does not warm"))
    return tuple(rows)


def _value(drive: Drive, path: str) -> float | str:
    """Return a number, or a word, of a drive."""
    value, words = value_at(drive, path), choices_of(Drive, path)
    return words[value] if words else float(value)


def compare(actuator: ActuatorModel, target: str) -> WrittenComparison:
    """Compare a motor to its model in another simulator.

    Args:
        actuator: a `Drive` or a `TorqueSpeed`.
        target: `mjlab`, `isaaclab`, `newton`, `dcmotor` or `bam`.
    """
    if isinstance(actuator, Drive) and actuator.friction is not None:
        # Both simulators have the constant friction, one in the torque and one in the joint.
        actuator = actuator.replaced({"friction.base": 0.0, "friction.viscous": 0.0})
    line = torque_speed_line(actuator)
    # An even number of points leaves out the standstill, where friction has no direction.
    ends = np.linspace(-OVERRANGE, OVERRANGE, NUM_POINTS)
    grid = np.meshgrid(ends * line.no_load_speed, ends * line.stall_torque)
    speeds, desired = (points.ravel() for points in grid)
    errors = np.abs(
        steady_torque(actuator, desired, speeds) - _law(actuator, target)(desired, speeds)
    )
    worst = int(np.argmax(errors))
    ours, theirs = _motions(actuator, target, line)
    return WrittenComparison(
        float(errors[worst]),
        line.stall_torque,
        float(speeds[worst]),
        float(desired[worst]),
        float(np.max(np.abs(ours - theirs))),
        float(np.ptp(ours)),
    )


def steady_torque(actuator: ActuatorModel, desired: np.ndarray, speed: np.ndarray) -> np.ndarray:
    """Return our motor's torque at the joint at held speeds, at ambient temperature.

    Args:
        actuator: a `Drive` or a `TorqueSpeed`.
        desired: desired torques [N*m], or forces [N], at the joint, of any shape.
        speed: speeds of the joint, of the same shape.
    """
    family, arm, timestep = type(actuator), actuator.arm_radius, 0.02
    parameters = parameters_type(family)(*actuator.parameter_values)
    if isinstance(actuator, Drive):
        parameters = parameters._replace(
            thermal_resistance_winding=0.0, thermal_resistance_housing=0.0
        )
        # The winding settles within the first step, which is a whole number of samples.
        shortest = max(timestep, 20.0 * actuator.motor.electrical_time_constant)
        rate = actuator.controller.sample_rate
        timestep = math.ceil(shortest * rate) / rate
    state = _at_rest(actuator, np.zeros_like(speed))
    torque: np.ndarray = np.zeros_like(speed)
    # The load of a held speed balances the torque. Half of its error remains after a step.
    for step in range(2 if friction_of(actuator) is None else 50):
        # With a huge inertia the speed is held, and friction is not limited to what stops a rotor.
        # The fields of `Inputs` are floats, but `advance` takes arrays in their place.
        arrays: FamilyTuple = (desired * arm, 0.0, speed / arm, step * timestep, 0.0, _HELD)
        state, torque, _ = advance(family, np, tuple(parameters), timestep, state, Inputs(*arrays))
    return torque / arm


def _at_rest(actuator: ActuatorModel, zero: float | np.ndarray) -> FamilyTuple:
    """Return the state of an actuator at the start of an episode, of zeros of any shape."""
    state: FamilyTuple = type(actuator).State
    return state(*[zero for _ in state._fields])


def _law(actuator: ActuatorModel, target: str) -> Law:
    """Return the steady torque of the model in another simulator."""
    if target in _LINES:
        line = torque_speed_line(actuator)
        return lambda desired, speed: steady_torque(line, desired, speed)
    if target == "bam":
        return lambda desired, speed: bam_torque(actuator, desired, speed)
    winding = winding_of(actuator, target)
    return lambda desired, speed: winding_torque(winding, desired, speed)


def _motions(
    actuator: ActuatorModel, target: str, line: TorqueSpeed
) -> tuple[np.ndarray, np.ndarray]:
    """Return the positions of the joint in the test motion, of our motor and of the other model."""
    rate = actuator.controller.sample_rate if isinstance(actuator, Drive) else 1000.0
    timestep = max(round(1e-3 * rate), 1) / rate
    inertia = line.stall_torque * RISE_TIME / line.no_load_speed
    amplitude = min(line.stall_torque, line.max_torque)
    times = timestep * np.arange(round(1.0 / timestep))
    commands = amplitude * np.cos(2.0 * math.pi * COMMAND_FREQUENCY * times)
    ours = _move(_stepper(actuator, timestep, inertia), commands, timestep, inertia)
    if target == "dcmotor":
        return ours, _move_in_mujoco(actuator, commands, timestep, inertia)
    if target in _LINES:
        return ours, _move(_stepper(line, timestep, inertia), commands, timestep, inertia)

    friction, winding = friction_of(actuator), winding_of(actuator, "bam")

    def bam(desired: float, speed: float, time: float) -> float:
        del time
        point = np.array(desired), np.array(speed)
        if friction is None:
            return float(bam_torque(actuator, *point))
        # The load is free, so friction is at most the torque that stops it within the step.
        torque = bam_motor_torque(winding, *point)
        stopping = inertia * speed / timestep + torque
        limit = friction.limit(point[1], torque, np.array(0.0))
        return float(torque - np.clip(stopping, -limit, limit))

    return ours, _move(bam, commands, timestep, inertia)


def _stepper(actuator: ActuatorModel, timestep: float, inertia: float) -> Stepper:
    """Return a function that advances one of our actuators, whose torques are those at the joint.

    The inertia [kg*m^2] is that of joint and rotor.
    """
    arm, parameters = actuator.arm_radius, parameters_type(type(actuator))
    values, state = parameters(*actuator.parameter_values), [_at_rest(actuator, 0.0)]

    def step(desired: float, speed: float, time: float) -> float:
        inputs = Inputs(desired * arm, 0.0, speed / arm, time, 0.0, inertia * arm * arm)
        state[0], torque, _ = actuator.advance(values, timestep, state[0], inputs)
        return torque / arm

    return step


def _move(stepper: Stepper, commands: np.ndarray, timestep: float, inertia: float) -> np.ndarray:
    """Return positions of a load under commands, by the semi-implicit Euler steps of MuJoCo."""
    position, speed, positions = 0.0, 0.0, []
    for index, command in enumerate(commands):
        speed += timestep * stepper(float(command), speed, index * timestep) / inertia
        position += timestep * speed
        positions.append(position)
    return np.array(positions)


def _move_in_mujoco(
    actuator: ActuatorModel, commands: np.ndarray, timestep: float, inertia: float
) -> np.ndarray:
    """Return positions of a load that the written `<dcmotor>` moves in MuJoCo."""
    # MuJoCo is imported here, because all other notations are written without it.
    import mujoco

    winding = winding_of(actuator, "dcmotor")
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><option timestep="{timestep!r}"/><worldbody><body>
        <joint name="joint" armature="{inertia!r}"/>
        <inertial pos="0 0 0" mass="1e-9" diaginertia="1e-15 1e-15 1e-15"/>
        </body></worldbody><actuator>{dcmotor_element(actuator, "joint")}</actuator></mujoco>"""
    )
    data, positions = mujoco.MjData(model), []
    for command in commands:
        data.ctrl[0] = winding.volts_per_force * command + winding.volts_per_speed * data.qvel[0]
        mujoco.mj_step(model, data)
        positions.append(float(data.qpos[0]))
    return np.array(positions)
