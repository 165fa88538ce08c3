"""Random parameters, states and inputs of each family, and the results of its plain Python.

Every option is on in some actuators and off in others, and voltages and currents saturate in some.
Actuators that their own class refuses, by the bounds of its fields or by `check`, are left out.
"""

import functools
import math
import warnings
from typing import NamedTuple

import numpy as np

from codrl_mj.actuators import (
    DCMotorActuator,
    Drive,
    Ideal,
    Inputs,
    Lag,
    PwmServo,
    Servo,
    SharedDrive,
    SharedVoltageDrive,
    TorqueSpeed,
    VoltageDrive,
    VoltageDriven,
    parameters_type,
)
from tests.arrays.gearbox import Gearbox

INF = math.inf


class Case(NamedTuple):
    """Actuators of one family before a step."""

    family: type
    timestep: float
    parameters: np.ndarray
    """Shape (n, p)."""
    state: np.ndarray
    """Shape (n, s)."""
    inputs: np.ndarray
    """Shape (n, 6)."""
    scales: np.ndarray
    """Shape (n, s + 1 + k): natural units of the entries of state, torque and signals."""

    def arguments(self, convert):
        """Return the arguments of `advance` with converted columns instead of floats."""
        types = parameters_type(self.family), self.family.State, Inputs
        rows = self.parameters, self.state, self.inputs
        parameters, state, inputs = (
            kind(*map(convert, table.T)) for kind, table in zip(types, rows, strict=True)
        )
        return parameters, self.timestep, state, inputs


class Draw:
    """Random columns of n numbers."""

    def __init__(self, seed, n):  # noqa: D107
        self.rng, self.n = np.random.default_rng(seed), n

    def log(self, low, high):
        return np.exp(self.rng.uniform(math.log(low), math.log(high), self.n))

    def uniform(self, low, high):
        return self.rng.uniform(low, high, self.n)

    def normal(self, scale=1.0):
        return self.rng.normal(0.0, 1.0, self.n) * scale

    def choice(self, *values):
        return self.rng.choice(values, self.n)

    def sometimes(self, share, values, default=0.0):
        return np.where(self.rng.random(self.n) < share, values, default)


def defaults(family, n):
    actuator = family()
    names = parameters_type(family)._fields
    return {
        name: np.full(n, value)
        for name, value in zip(names, actuator.parameter_values, strict=True)
    }


def inputs_of(draw, timestep, **columns):
    """Return inputs of an ordinary joint, some of them replaced."""
    default = {
        "desired_torque": draw.normal(),
        "position": draw.normal(),
        "speed": draw.normal(10.0),
        "time": draw.rng.integers(0, 500, draw.n) * timestep,
        "noise_key": draw.rng.integers(0, 2**53, draw.n).astype(float),
        "inertia": np.full(draw.n, INF),
    }
    return default | columns


def motor_columns(draw):
    """Return parameters of the motor of a drive."""
    r, kt = draw.log(0.1, 20), draw.log(3e-3, 0.3)
    has_heat = draw.rng.random(draw.n) < 0.5
    return {
        "resistance": r,
        "inductance": r * draw.log(5e-5, 5e-3),
        "torque_constant": kt,
        "back_emf_constant": draw.sometimes(0.95, kt * draw.uniform(0.9, 1.1)),
        "rotor_inertia": draw.sometimes(0.9, draw.log(1e-7, 1e-4)),
        "gear_ratio": draw.sometimes(0.7, draw.log(1, 200), 1.0),
        "gear_efficiency": draw.sometimes(0.4, draw.uniform(0.5, 1.0), 1.0),
        "viscous_friction": draw.sometimes(0.5, draw.log(1e-8, 1e-5)),
        "coulomb_friction": draw.sometimes(0.5, draw.log(1e-5, 1e-2)),
        "stribeck_friction": draw.sometimes(0.4, draw.log(1e-5, 1e-2)),
        "stribeck_speed": draw.log(0.1, 100),
        "stribeck_exponent": draw.sometimes(0.5, draw.uniform(0.5, 5), 2.0),
        "load_inertia": draw.sometimes(0.05, INF, draw.sometimes(0.2, draw.log(1e-5, 1e-1))),
        "thermal_resistance_winding": np.where(has_heat, draw.log(0.5, 10), 0.0),
        "thermal_resistance_housing": np.where(
            has_heat, draw.sometimes(0.8, draw.log(0.5, 10)), 0.0
        ),
        "max_temperature": np.where(has_heat, draw.sometimes(0.6, 125.0, INF), INF),
    }


def loop_columns(draw, motor):
    """Return parameters of the current loop and the supply of a drive."""
    r, voltage = motor["resistance"], draw.choice(6.0, 12.0, 24.0, 48.0)
    has_gains = draw.rng.random(draw.n) < 0.2
    return {
        "sample_rate": draw.choice(10e3, 20e3, 40e3),
        "bandwidth": draw.sometimes(0.5, draw.log(50, 1500)),
        "kp": np.where(has_gains, motor["inductance"] * draw.log(300, 3000), 0.0),
        "ki": np.where(has_gains, r * draw.log(300, 3000), 0.0),
        "anti_windup": draw.choice(0.0, 0.0, 1.0, 2.0),
        "delayed": draw.sometimes(0.2, 1.0),
        "bemf_compensation": draw.sometimes(0.8, 1.0),
        "supply_voltage": voltage,
        "supply_resistance": draw.sometimes(0.2, 0.05 * r),
        "deadband": draw.sometimes(0.2, 0.02 * voltage),
        "max_current": draw.sometimes(0.5, voltage / r * draw.uniform(0.1, 1.0), INF),
    }


def friction_columns(draw, torque):
    """Return parameters of the friction of servos, for a torque [N*m] at the output."""
    shares = ("load_motor", "load_external", "load_motor_stribeck", "load_external_stribeck")
    columns = {
        "base": draw.sometimes(0.7, torque * draw.log(1e-3, 0.2)),
        "viscous": draw.sometimes(0.5, torque * draw.log(1e-5, 1e-3)),
        "stribeck": draw.sometimes(0.5, torque * draw.log(1e-3, 0.2)),
        "stribeck_speed": draw.log(0.1, 10),
        "stribeck_exponent": draw.uniform(0.5, 5),
        **{name: draw.sometimes(0.6, draw.uniform(0.0, 0.4)) for name in shares},
        "load_motor_quadratic": draw.sometimes(0.5, draw.uniform(0.0, 0.1) / torque),
        "load_external_quadratic": draw.sometimes(0.5, draw.uniform(0.0, 0.1) / torque),
    }
    return {f"friction_{name}": values for name, values in columns.items()}


def with_servo_friction(draw, p):
    """Return parameters of which a third have the friction of servos instead of the motor's."""
    torque = p["supply_voltage"] / p["resistance"] * p["torque_constant"] * p["gear_ratio"]
    is_servo = draw.rng.random(draw.n) < 0.33
    without = dict.fromkeys(("coulomb_friction", "viscous_friction", "stribeck_friction"), 0.0)
    without |= {"gear_efficiency": 1.0}
    changed = without | friction_columns(draw, torque)
    return p | {name: np.where(is_servo, values, p[name]) for name, values in changed.items()}


def drive_case(draw, family=Drive, timestep=0.002):
    n, motor = draw.n, motor_columns(draw)
    p = with_servo_friction(draw, defaults(family, n) | motor | loop_columns(draw, motor))
    stall, kt, voltage = (
        p["supply_voltage"] / p["resistance"],
        motor["torque_constant"],
        p["supply_voltage"],
    )
    ke = np.where(p["back_emf_constant"] > 0, p["back_emf_constant"], kt)
    has_heat = p["thermal_resistance_winding"] > 0
    speed = draw.sometimes(0.95, voltage / ke * draw.uniform(-1.2, 1.2))
    time = draw.rng.integers(0, 500, n) * timestep
    state = {
        "current": stall * draw.uniform(-1, 1),
        "integral": voltage * draw.uniform(-1, 1),
        "pending": voltage * draw.uniform(-1, 1),
        "winding_rise": np.where(has_heat, draw.uniform(0, 110), 0.0),
        "housing_rise": np.where(has_heat, draw.uniform(0, 40), 0.0),
        "acceleration": draw.normal(100.0),
        "speed": speed + draw.normal(0.3),
        "external_acceleration": draw.normal(30.0),
        "expected_time": draw.sometimes(0.7, time),
    }
    # What `check_shaft` refuses or warns of is left out: a back-EMF that brakes the rotor to a stop
    # within a few samples. No factor puts actuators exactly where a step gets another piece, because
    # results jump there and rounding would decide.
    braking = kt * p["back_emf_constant"] / p["resistance"] * timestep
    load_inertia = p["load_inertia"]
    is_told = (load_inertia > 0) & np.isfinite(load_inertia)
    lowest = np.maximum(0.7 * braking - p["rotor_inertia"], 1e-12)
    p["load_inertia"] = np.where(
        is_told, np.maximum(load_inertia, lowest * p["gear_ratio"] ** 2), load_inertia
    )
    p["load_inertia"] = np.where(
        np.isinf(load_inertia) & (braking > 0.5 * p["rotor_inertia"]), 0.0, p["load_inertia"]
    )
    inertia = np.maximum(p["rotor_inertia"] + draw.log(1e-6, 1e-2), 0.7 * braking)
    inputs = inputs_of(
        draw,
        timestep,
        desired_torque=kt * stall * draw.uniform(-1.5, 1.5),
        position=draw.uniform(-300, 300),
        speed=speed,
        time=time,
        inertia=draw.sometimes(0.1, INF, inertia),
    )
    units = {
        **dict.fromkeys(("current", "reference_current"), stall),
        **dict.fromkeys(("integral", "pending", "voltage"), voltage),
        **dict.fromkeys(("winding_rise", "housing_rise", "temperature"), 100.0),
        **dict.fromkeys(("electrical_power", "copper_loss"), stall * voltage),
        **dict.fromkeys(("torque", "velocity_integral", "commanded_torque"), kt * stall),
        "acceleration": kt
        * stall
        / np.where(np.isfinite(inputs["inertia"]), inputs["inertia"], 1.0),
        "speed": voltage / ke,
    }
    return timestep, p, state, inputs, units


def shared_drive_case(draw, family):
    timestep, p, state, inputs, units = drive_case(draw, family)
    p["deadband"] = np.zeros(draw.n)
    p["supply_recharges"] = draw.sometimes(0.5, 1.0)
    units["supply_voltage"], units["supply_current"] = units["voltage"], units["current"]
    return timestep, p, state, inputs, units


def servo_case(draw):
    n = draw.n
    timestep, p, state, inputs, units = drive_case(draw, Servo)
    ratio, is_position = p["gear_ratio"], draw.rng.random(n) < 0.5
    moved = np.where(np.isfinite(inputs["inertia"]), inputs["inertia"], 1e-4) * ratio**2
    p |= {
        "controls": np.where(is_position, 0.0, 1.0),
        "servo_rate": draw.choice(250.0, 500.0, 1000.0, 2000.0),
        "position_gain": draw.log(2, 30),
        "velocity_gain": moved * draw.log(10, 200),
        "velocity_integral_gain": draw.sometimes(0.5, draw.log(1, 50)),
        "velocity_feed_forward": np.where(is_position, draw.sometimes(0.5, 1.0), 0.0),
        "inertia_feed_forward": np.where(is_position, 0.0, draw.sometimes(0.5, moved)),
        "max_velocity": draw.sometimes(0.5, units["speed"] / ratio * draw.uniform(0.2, 1), INF),
        "max_torque": draw.sometimes(0.5, units["torque"] * ratio * draw.uniform(0.1, 1), INF),
    }
    target = np.where(
        is_position, inputs["position"] + draw.normal(ratio), units["speed"] * draw.uniform(-1, 1)
    )
    inputs["desired_torque"] = target
    state |= {
        "velocity_integral": units["torque"] * draw.uniform(-0.5, 0.5),
        "target": target + draw.normal(0.01),
        "commanded_torque": units["torque"] * draw.uniform(-1, 1),
        "steps_to_sample": draw.rng.integers(0, 3, n).astype(float),
    }
    # The commanded torque is a large gain times the difference of two positions.
    gain = p["velocity_gain"] / ratio**2
    commanded = gain * (p["position_gain"] * 300.0 + units["speed"])
    units |= dict.fromkeys(("commanded_torque", "velocity_integral"), commanded)
    # The integral is a difference of voltages that belong to the requested current.
    requested = np.minimum(commanded / p["torque_constant"], p["max_current"])
    units["integral"] = p["supply_voltage"] + p["resistance"] * requested
    return timestep, p, state, inputs, units | {"error": 300.0 / ratio}


def pwm_servo_case(draw):
    n, timestep = draw.n, 0.002
    _, p, state, inputs, units = drive_case(draw, Drive)
    p = {name: p[name] for name in parameters_type(PwmServo)._fields if name in p}
    state = {name: state[name] for name in PwmServo.State._fields if name in state}
    ratio = p["gear_ratio"]
    position = inputs["position"] / ratio
    command = position + draw.normal(0.3)
    p = defaults(PwmServo, n) | p
    p |= {
        "position_gain": draw.log(0.5, 20),
        "integral_gain": draw.sometimes(0.5, draw.log(0.5, 20)),
        "derivative_gain": draw.sometimes(0.5, draw.log(0.001, 0.1)),
        "servo_rate": draw.choice(100.0, 250.0, 500.0, 1000.0, 2000.0),
        "max_duty": draw.sometimes(0.5, draw.uniform(0.5, 1.0), 1.0),
        "start_duty": draw.sometimes(0.3, draw.uniform(0.01, 0.1)),
        "deadband": draw.sometimes(0.3, draw.log(0.001, 0.3)),
        "encoder_counts": draw.sometimes(0.3, 4096.0),
        "max_velocity": draw.sometimes(0.5, draw.log(0.5, 20), INF),
        "max_acceleration": draw.sometimes(0.5, draw.log(5, 500), INF),
        "command_rate": draw.choice(50.0, 60.0, 1000.0),
        "command_delay": draw.sometimes(0.5, draw.uniform(0.0, 0.01)),
        "command_jitter": draw.sometimes(0.5, 0.0009),
    }
    inputs["desired_torque"] = command * ratio
    interval = np.maximum(1.0 / p["command_rate"], timestep)
    sent = np.floor(inputs["time"] / interval + 1e-6)
    state |= {
        "target": position + draw.normal(0.2),
        "target_velocity": draw.normal(2.0),
        "error": draw.normal(0.2),
        "integral": draw.uniform(-0.5, 0.5),
        "duty": draw.uniform(-1, 1),
        "steps_to_sample": draw.rng.integers(0, 3, n).astype(float),
        "sent": sent + draw.choice(0.0, 1.0),
        **{f"c{k}": command + draw.normal(0.2) for k in range(1, 9)},
    }
    # Positions are up to 300 rad, and the gain of the error's rate multiplies their rounding.
    duty = 300.0 * (p["position_gain"] + p["derivative_gain"] * p["servo_rate"])
    scale = {name: units[name] for name in units if name in (*state, *PwmServo.Signals._fields)}
    scale |= dict.fromkeys(("duty", "integral"), duty) | {"torque": units["torque"] * duty}
    scale |= {name: units[name] * duty for name in ("current", "voltage", "acceleration")}
    scale |= {name: units[name] * duty**2 for name in ("electrical_power", "copper_loss")}
    scale |= dict.fromkeys(("error", "target", *(f"c{k}" for k in range(1, 9))), 300.0 / ratio)
    scale |= {"target_velocity": 300.0 * p["servo_rate"]}
    return timestep, p, state, inputs, scale


def current_loop_case(draw, family=DCMotorActuator):
    n, timestep = draw.n, 0.02
    p = defaults(family, n) | {
        "resistance": draw.log(0.3, 5),
        "inductance": draw.log(0.05, 1),
        "torque_constant": draw.log(0.3, 3),
        "back_emf_constant": draw.log(0.3, 3),
        "kp": draw.log(0.1, 10),
        "ki": draw.sometimes(0.7, draw.log(0.1, 10)),
        "kd": draw.sometimes(0.3, draw.log(1e-4, 1e-3)),
        "kff": draw.sometimes(0.5, draw.log(0.1, 1)),
        "max_voltage": draw.choice(6.0, 12.0, 24.0, INF),
        "bemf_compensation": draw.choice(0.0, 1.0),
        "substeps": draw.choice(1.0, 4.0, 10.0),
        "integral_leak": draw.sometimes(0.3, draw.log(0.1, 3)),
        "derivative_time_constant": draw.sometimes(0.3, draw.log(1e-3, 1e-1)),
        "current_bias": draw.sometimes(0.3, draw.normal(0.1)),
        "current_noise": draw.sometimes(0.5, 0.05),
        "supply_voltage": draw.choice(9.0, 18.0, INF),
        "supply_resistance": draw.sometimes(0.5, draw.log(0.01, 0.5)),
    }
    state = {"current": draw.normal(5.0), "integral": draw.normal(), "error": draw.normal()}
    inputs = inputs_of(draw, timestep, desired_torque=draw.normal(10.0), speed=draw.normal(5.0))
    units = {"current": 5.0, "torque": 5.0, "voltage": 10.0, "integral": 1.0, "error": 1.0}
    return timestep, p, state, inputs, units


def lag_case(draw):
    timestep, n = 0.002, draw.n
    whole = draw.rng.integers(0, 9, n) * timestep
    p = {
        "time_constant": draw.sometimes(0.8, draw.log(1e-3, 1)),
        "delay": draw.sometimes(0.3, whole, draw.sometimes(0.7, draw.uniform(0, 8 * timestep))),
        "gain": draw.uniform(0.5, 1.5),
    }
    state = {name: draw.normal() for name in Lag.State._fields}
    return timestep, p, state, inputs_of(draw, timestep), {}


def torque_speed_case(draw):
    p = {
        "stall_torque": draw.log(0.1, 10),
        "no_load_speed": draw.log(1, 100),
        "max_torque": draw.sometimes(0.7, draw.log(0.05, 10), INF),
    }
    return 0.002, p, {}, inputs_of(draw, 0.002, desired_torque=draw.normal(5.0)), {}


def gearbox_case(draw):
    p = {"crossing_time": draw.log(0.002, 1), "efficiency": draw.uniform(0.1, 1)}
    state = {"play": np.clip(draw.uniform(-1.5, 1.5), -1, 1)}
    return 0.002, p, state, inputs_of(draw, 0.002), {}


FAMILIES = {
    "current_loop": (DCMotorActuator, current_loop_case),
    "voltage_driven": (VoltageDriven, lambda draw: current_loop_case(draw, VoltageDriven)),
    "drive": (Drive, drive_case),
    "voltage_drive": (VoltageDrive, lambda draw: drive_case(draw, VoltageDrive)),
    "shared_drive": (SharedDrive, lambda draw: shared_drive_case(draw, SharedDrive)),
    "shared_voltage_drive": (
        SharedVoltageDrive,
        lambda draw: shared_drive_case(draw, SharedVoltageDrive),
    ),
    "servo": (Servo, servo_case),
    "pwm_servo": (PwmServo, pwm_servo_case),
    "lag": (Lag, lag_case),
    "torque_speed": (TorqueSpeed, torque_speed_case),
    "ideal": (Ideal, lambda draw: (0.002, {}, {}, inputs_of(draw, 0.002), {})),
    "gearbox": (Gearbox, gearbox_case),
}
"""Name -> family and function that draws its actuators: all built-in families and a custom one."""


def is_admissible(family, row, timestep):
    """Return True if the family accepts a row of parameters at a time step."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            family.from_parameter_values(row).check(timestep)
    except ValueError:
        return False
    return True


def table(columns, names, n):
    values = [np.broadcast_to(columns[name], n) for name in names]
    return np.stack(values, 1) if values else np.zeros((n, 0))


@functools.cache
def case(name, num):
    """Return at least half of `num` admissible actuators of a family."""
    family, draw_columns = FAMILIES[name]
    draw = Draw(0, num)
    timestep, p, state, inputs, units = draw_columns(draw)
    rows = table(p, parameters_type(family)._fields, num)
    outputs = (*family.State._fields, "torque", *family.Signals._fields)
    scales = table(dict.fromkeys(outputs, 1.0) | units, outputs, num)
    good = [k for k in range(num) if is_admissible(family, rows[k], timestep)]
    assert len(good) >= num // 2
    tables = (
        rows,
        table(state, family.State._fields, num),
        table(inputs, Inputs._fields, num),
        scales,
    )
    return Case(family, timestep, *(np.ascontiguousarray(values[good]) for values in tables))


def for_single_precision(actuators):
    """Return actuators whose noise keys are whole numbers that a 32-bit float holds."""
    inputs = actuators.inputs.copy()
    inputs[:, Inputs._fields.index("noise_key")] %= 2**24
    return actuators._replace(inputs=inputs)


@functools.cache
def expected(name, num):
    """Return `python_results` of the actuators of a case."""
    return python_results(case(name, num))


def python_results(actuators):
    """Return states, torques and signals by the plain Python of the family, shape (n, s+1+k)."""
    types = parameters_type(actuators.family), actuators.family.State, Inputs
    tables = actuators.parameters, actuators.state, actuators.inputs
    results = []
    for rows in zip(*(values.tolist() for values in tables), strict=True):
        p, s, x = (kind(*row) for kind, row in zip(types, rows, strict=True))
        state, torque, signals = actuators.family.advance(p, actuators.timestep, s, x)
        results.append([*state, torque, *signals])
    return np.array(results)


def errors(name, num, results):
    """Return `errors_of` the results of a case."""
    return errors_of(case(name, num), expected(name, num), results)


def errors_of(actuators, values, results):
    """Return the errors of results, relative to the values or, if greater, their natural units.

    Flags are compared for equality: the error of a flag is 0 or infinite.
    """
    fields = (*actuators.family.State._fields, "torque", *actuators.family.Signals._fields)
    with np.errstate(invalid="ignore", divide="ignore"):
        size = np.maximum(np.abs(values), actuators.scales)
        error = np.abs(results - values) / size
    error = np.where((results == values) | (np.isnan(results) & np.isnan(values)), 0.0, error)
    error[np.isnan(error)] = INF
    flags = [index for index, field in enumerate(fields) if field.endswith("saturated")]
    error[:, flags] = np.where(results[:, flags] == values[:, flags], 0.0, INF)
    return error
