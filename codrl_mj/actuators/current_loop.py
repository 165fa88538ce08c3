"""The paper's actuator, family `current_loop`: a DC motor with a PID current loop.

Source of the equations and of the defaults: *Control-Optimized Deep Reinforcement Learning* (arXiv
2507.00268), Methodology; "the paper" below.

`advance` is plain Python on purpose: numba compiles it for MuJoCo's control callback and actuator
plugin, and the same source runs uncompiled in the analytic physics and in the stability analysis.
"""

import dataclasses
import math
from collections.abc import Mapping
from typing import ClassVar, NamedTuple

import numpy as np

from codrl_mj.actuators import noise, stability
from codrl_mj.actuators.model import ActuatorModel, Command, Inputs, UnstableError
from codrl_mj.actuators.parameters import FieldValue, Parameters
from codrl_mj.fields import Checked, flag, integer, optional_nested, real


@dataclasses.dataclass(frozen=True)
class Motor(Checked):
    """Brushed DC motor: resistance and inductance of the winding, torque and back-EMF constants.

    L di/dt = u - kE*omega - R*i and torque = kT*i (the paper, equations of the current update and
    of the torque).

    Raises:
        ValueError: a field is not a finite number within its bound; the message names field, value
            and bound.
    """

    resistance: float = real(1.0, above=0.0, unit="ohm")
    """Winding resistance R [ohm], > 0. The paper: 1, all tasks."""
    inductance: float = real(0.1, above=0.0, unit="H")
    """Winding inductance L [H], > 0. The paper: 0.1, all tasks."""
    torque_constant: float = real(1.0, above=0.0, unit="N*m/A")
    """Torque constant kT [N*m/A], > 0. The paper: 1, all tasks."""
    back_emf_constant: float = real(1.0, minimum=0.0, unit="V*s/rad")
    """Back-EMF constant kE [V*s/rad], >= 0; in SI units equal to kT for an ideal motor. The paper:
    1, all tasks.
    """
    arm_radius: float = real(1.0, above=0.0, unit="m")
    """Arm r [m] between shaft and load, > 0: torque = r*F and omega = v/r. On a hinge it is the
    inverse of the gear ratio (no unit). The paper: 0.15 for CartPole, else 1.
    """

    @property
    def electrical_time_constant(self) -> float:
        """Time constant L/R [s] of the current after a step of voltage, without a loop."""
        return self.inductance / self.resistance


@dataclasses.dataclass(frozen=True)
class CurrentLoop(Checked):
    """PID loop that computes the motor's terminal voltage from desired and measured current.

    u = sat(kp*e + ki*I + kd*D + kff*i_ref + kE*omega, +-max_voltage), with e = i_ref - i.

    Raises:
        ValueError: a field is not a finite number within its bound; the message names field, value
            and bound.
    """

    kp: float = real(1.0, minimum=0.0, unit="V/A")
    """Proportional gain [V/A], >= 0."""
    ki: float = real(0.0, minimum=0.0, unit="V/(A*s)")
    """Integral gain [V/(A*s)], >= 0."""
    kd: float = real(0.0, minimum=0.0, unit="V*s/A")
    """Derivative gain [V*s/A], >= 0."""
    kff: float = real(0.0, minimum=0.0, unit="V/A")
    """Feed-forward gain on the reference current [V/A], >= 0; kff = R holds the current without
    feedback.
    """
    max_voltage: float = real(24.0, above=0.0, unit="V", infinite=True)
    """Voltage limit u_max [V], > 0; `inf` for none. The paper gives no value: with its
    settings, the voltage never reaches 24 V.
    """
    bemf_compensation: bool = flag(True)
    """Add kE*omega to the voltage, which cancels the back-EMF unless the voltage saturates. The
    paper: yes.
    """
    substeps: int = integer(1, minimum=1)
    """Electrical steps per mechanical step, >= 1: for electrical time constants below the
    mechanical step.
    """
    integral_leak: float = real(0.0, minimum=0.0, unit="1/s")
    """Leak rate of the integral [1/s], >= 0: the low-pass form of the integral in the paper's
    appendix. 0: a plain sum.
    """
    derivative_time_constant: float = real(0.0, minimum=0.0, unit="s")
    """Time constant [s] of the low-pass filter on the derivative, >= 0: the high-pass form of the
    derivative in the paper's appendix. 0: the plain difference of two samples.
    """
    current_bias: float = real(0.0, unit="A")
    """Offset of the current sensor [A], added to the current that the controller measures."""
    current_noise: float = real(0.0, minimum=0.0, unit="A")
    """Standard deviation [A] of the current sensor's white noise, >= 0: a new value in each
    electrical step.
    """


@dataclasses.dataclass(frozen=True)
class Supply(Checked):
    """Power supply of the drive: a voltage source with an internal resistance.

    Raises:
        ValueError: a field is out of bounds; the message names field, value and bound.
    """

    voltage: float = real(math.inf, above=0.0, unit="V", infinite=True)
    """Open-circuit voltage [V], > 0. The controller's `max_voltage` also limits the terminal
    voltage; with `inf` it is the only limit.
    """
    resistance: float = real(0.0, minimum=0.0, unit="ohm")
    """Internal resistance [ohm], >= 0: the available voltage drops by resistance*|current|."""


class State(NamedTuple):
    """State of the current loop."""

    current: float
    """Motor current i [A]."""
    integral: float
    """Integral of the current error [A*s]."""
    error: float
    """Current error of the last electrical step [A]; low-passed if the derivative filter is on."""


class Signals(NamedTuple):
    """Signals of the loop at the end of a step."""

    current: float
    """Motor current [A]."""
    reference_current: float
    """Reference current [A] of the loop, from the command after all disturbances."""
    voltage: float
    """Terminal voltage [V] of the last electrical step."""
    saturated: float
    """1 if that voltage was at its limit."""


def advance(
    parameters: Parameters, timestep: float, state: State, inputs: Inputs
) -> tuple[State, float, Signals]:
    """Advance the loop by one mechanical step, with desired torque and speed held over it.

    The equations are the paper's Algorithm 1 (function DCMotorENVStep), with its CartPole
    feed-forward and the filters of its appendix, repeated `substeps` times with timestep/substeps.
    With both filters off, every operation is the paper's.

    The integral leaks as dI/dt = e - leak*I, and the derivative is that of the error filtered by
    1/(1 + Td*s). Both use backward Euler, so they are stable at any step and become the paper's sum
    and difference at leak = 0 and Td = 0.

    The controller reads i + current_bias + current_noise*n. The standard normal number n is a
    function of key, time and electrical step, so computing a step again gives the same value. The
    available voltage is the smaller of max_voltage and the supply's voltage, which drops with the
    current at the start of the electrical step.

    Args:
        parameters: named as the fields of `DCMotorActuator` and its parts.
        timestep: mechanical step [s].
        state: current, integral and error.
        inputs: desired torque [N*m] and speed [rad/s] at the motor's shaft, time [s] and noise key.
    """
    current, integral, error = state
    substeps = int(parameters.substeps)
    dt = timestep / substeps
    voltage, available = 0.0, min(parameters.max_voltage, parameters.supply_voltage)
    open_circuit = (
        parameters.max_voltage
        if math.isinf(parameters.supply_voltage)
        else parameters.supply_voltage
    )
    for substep in range(substeps):
        sensor_error = parameters.current_bias
        if parameters.current_noise > 0.0:
            # MuJoCo may call the callback at intermediate times of a step, so the step's index is
            # rounded.
            step = int(inputs.time / timestep + 0.5)
            sensor_error += parameters.current_noise * noise.standard_normal(
                inputs.noise_key, step, substep
            )
        if parameters.supply_resistance > 0.0:
            sag = parameters.supply_resistance * abs(current)
            available = min(parameters.max_voltage, max(open_circuit - sag, 0.0))
        current, integral, error, voltage = electrical_step(
            parameters,
            dt,
            current,
            integral,
            error,
            inputs.desired_torque,
            inputs.speed,
            sensor_error,
            available,
        )
    reference = inputs.desired_torque / parameters.torque_constant
    saturated = 1.0 if abs(voltage) >= available else 0.0
    torque = parameters.torque_constant * current
    return State(current, integral, error), torque, Signals(current, reference, voltage, saturated)


def electrical_step(
    parameters: Parameters,
    dt: float,
    current: float,
    integral: float,
    previous_error: float,
    desired_torque: float,
    speed: float,
    sensor_error: float,
    limit: float,
) -> tuple[float, float, float, float]:
    """Advance controller and winding by one sample; all uses of the equations call this.

    Args:
        parameters: as for `advance`. The stability analysis passes arrays of parameters and states.
        dt: electrical step [s].
        current: [A].
        integral: [A*s].
        previous_error: [A].
        desired_torque: [N*m].
        speed: [rad/s].
        sensor_error: measured minus actual current [A].
        limit: largest magnitude of the voltage [V].

    Returns:
        New current [A], integral [A*s] and error [A], and the voltage [V].
    """
    back_emf = parameters.back_emf_constant * speed
    reference = desired_torque / parameters.torque_constant
    feed_forward = parameters.kff * reference + parameters.bemf_compensation * back_emf
    error = reference - current - sensor_error
    integral = (integral + error * dt) / (1.0 + parameters.integral_leak * dt)
    derivative = (error - previous_error) / (dt + parameters.derivative_time_constant)
    previous_error = error - parameters.derivative_time_constant * derivative
    voltage = (
        parameters.kp * error + parameters.ki * integral + parameters.kd * derivative + feed_forward
    )
    voltage = min(max(voltage, -limit), limit)
    current = (
        current
        + (voltage - back_emf - parameters.resistance * current) / parameters.inductance * dt
    )
    return current, integral, previous_error, voltage


def observe(
    parameters: Parameters, timestep: float, signals: Signals, inputs: Inputs
) -> tuple[float, float]:
    """Return the measured current [A] of the next electrical step, and the reference [A]."""
    error = parameters.current_bias
    if parameters.current_noise > 0.0:
        step = math.floor(inputs.time / timestep + 0.5)
        error += parameters.current_noise * noise.standard_normal(inputs.noise_key, step, 0)
    return signals.current + error, signals.reference_current


_APPLIED_TO_VOLTAGE = ("max_voltage", "substeps", "current_bias", "current_noise")
"""Fields of the controller that still apply if the agent commands the voltage."""


@dataclasses.dataclass(frozen=True)
class DCMotorActuator(ActuatorModel):
    """Motor and current loop between the desired force and the delivered force."""

    family: ClassVar[str] = "current_loop"
    electrical_step: ClassVar[stability.ElectricalStep] = staticmethod(electrical_step)
    State: ClassVar[type[NamedTuple]] = State
    Signals: ClassVar[type[NamedTuple]] = Signals
    SIGNAL_UNITS: ClassVar[Mapping[str, str]] = {
        "current": "A",
        "reference_current": "A",
        "voltage": "V",
    }
    OBSERVED: ClassVar[tuple[str, ...]] = ("current", "reference_current")
    RANDOM: ClassVar[tuple[str, ...]] = ("controller.current_noise",)
    advance: ClassVar = staticmethod(advance)
    observe: ClassVar = staticmethod(observe)

    motor: Motor = Motor()
    """The motor and its arm."""
    controller: CurrentLoop = CurrentLoop()
    """The current loop and its sensor."""
    supply: Supply | None = optional_nested(Supply())
    """Supply of the drive; None: `controller.max_voltage` at any current."""

    @property
    def arm_radius(self) -> float:
        """Arm [m] of the motor."""
        return self.motor.arm_radius

    @property
    def back_emf_damping(self) -> float:
        """Damping kT*kE/R at the load, as in `ActuatorModel.back_emf_damping`."""
        motor = self.motor
        return (
            motor.torque_constant
            * motor.back_emf_constant
            / (motor.resistance * motor.arm_radius**2)
        )

    @property
    def winding(self) -> tuple[float, float]:
        """Resistance [ohm] and inductance [H]."""
        return self.motor.resistance, self.motor.inductance

    @property
    def voltage_limit(self) -> float:
        """Largest voltage [V] at zero current."""
        return min(
            self.controller.max_voltage, math.inf if self.supply is None else self.supply.voltage
        )

    @property
    def assumed(self) -> str:
        """Note on a default voltage limit that limits the supply; see `ActuatorModel.assumed`."""
        max_voltage = self.controller.max_voltage
        voltage = math.inf if self.supply is None else self.supply.voltage
        if not (max_voltage == CurrentLoop.max_voltage and max_voltage < voltage < math.inf):
            return ""
        limit = (
            f"controller.max_voltage = {max_voltage:g} V, which limits the supply of {voltage:g} V"
        )
        return f"assumed, because not specified: {limit}"

    def commands(self) -> Mapping[str, Command]:
        """Return the commands `current` [A] and, bypassing the controller, `voltage` [V]."""
        torque = self.motor.torque_constant
        fixed = dict.fromkeys(
            ("motor.torque_constant", "motor.arm_radius"), "it would change what an action means"
        )
        bypassed = [
            f"controller.{f.name}" for f in dataclasses.fields(CurrentLoop) if f.name != "substeps"
        ]
        # With kff = 1 V/A and everything else 0, this controller passes the command on as a
        # voltage.
        voltage_fixed = fixed | dict.fromkeys(bypassed, "the command bypasses the controller")
        feed_through = dataclasses.replace(
            CurrentLoop(kp=0.0, kff=1.0, bemf_compensation=False),
            **{name: getattr(self.controller, name) for name in _APPLIED_TO_VOLTAGE},
        )
        driven = VoltageDriven(self.motor, feed_through, self.supply)
        return {
            "current": Command("A", self, torque, None, fixed),
            "voltage": Command("V", driven, torque, self.voltage_limit, voltage_fixed),
        }

    def check(self, timestep: float) -> None:
        """Raise if the loop, or the current of a saturated motor at this supply, is unstable.

        Raises:
            ValueError: the spectral radius is 1 or more; the message has the number and a remedy
                that was checked.
        """
        if self.supply is not None and self.supply.resistance:
            substeps = self.controller.substeps
            bound = 2.0 * self.motor.inductance * substeps / timestep - self.motor.resistance
            if not self.supply.resistance < bound:
                raise UnstableError(
                    f"actuator: supply.resistance = {self.supply.resistance:g}: must be < 2*L/dt -"
                    f" R = {bound:g} ohm at an electrical step of {timestep / substeps:g} s, or a"
                    " saturated motor's current oscillates from step to step. Raise"
                    " controller.substeps, or pass allow_unstable=True"
                )
        stability.check_stable(self, timestep)

    @classmethod
    def instability(cls, parameter_values: np.ndarray, timestep: float) -> np.ndarray:
        """Return the larger spectral radius of the loop and of a saturated motor at its supply."""
        columns = stability.parameter_columns(cls, parameter_values)
        radii = stability.stability_radii(cls, parameter_values, timestep)
        # A saturated voltage drops with the current: the supply closes a loop of its own.
        pole = (
            (columns.resistance + columns.supply_resistance)
            * timestep
            / (columns.inductance * columns.substeps)
        )
        return np.where(
            columns.supply_resistance > 0.0, np.maximum(radii, np.abs(1.0 - pole)), radii
        )

    def as_mapping(self) -> dict[str, FieldValue]:
        """Return the mapping that `actuator_from_mapping` reads; the default family is left out."""
        return dataclasses.asdict(self) if type(self) is DCMotorActuator else super().as_mapping()


def _advance_driven(
    parameters: Parameters, timestep: float, state: State, inputs: Inputs
) -> tuple[State, float, Signals]:
    """Run `advance`, and report the current as its own reference.

    An agent that commands the voltage desires no particular current.
    """
    state, torque, signals = advance(parameters, timestep, state, inputs)
    return (
        state,
        torque,
        Signals(signals.current, signals.current, signals.voltage, signals.saturated),
    )


def _observe_driven(
    parameters: Parameters, timestep: float, signals: Signals, inputs: Inputs
) -> tuple[float, float]:
    """Return the measured current [A], which is also its own reference."""
    measured, _ = observe(parameters, timestep, signals, inputs)
    return measured, measured


@dataclasses.dataclass(frozen=True)
class VoltageDriven(DCMotorActuator):
    """Motor with a commanded voltage.

    With no feedback, a feed-forward gain of 1 V/A and no back-EMF compensation, the terminal
    voltage in volts is the reference current in amperes.
    """

    family: ClassVar[str] = ""
    is_torque_controlled: ClassVar[bool] = False
    advance: ClassVar = staticmethod(_advance_driven)
    observe: ClassVar = staticmethod(_observe_driven)
