"""An off-the-shelf motor behind an off-the-shelf drive, family `drive`: gear, rotor, friction, a sampled PI loop.

Where the paper's `current_loop` takes one or a few Euler steps of a slow winding, a bench motor's
winding has a time constant of 0.1 to 5 ms under a loop that samples at 10 to 40 kHz. The winding is
exact here, the loop has a sample rate of its own, its integrator does not wind up, and what is
delivered over a mechanical step is the *mean* torque of it: the current at the end of a step says
little of what moved the load.
"""

import dataclasses
import math
import warnings
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, NamedTuple

import numpy as np

from codrl_mj.actuators import sampled, shaft, stability
from codrl_mj.actuators.current_loop import Supply
from codrl_mj.actuators.gear_motor import GearMotor
from codrl_mj.actuators.model import ActuatorModel, Command, Inputs, JointAdditions, UnstableError
from codrl_mj.actuators.parameters import parameters_type
from codrl_mj.actuators.sampled_loop import DEFAULT_BANDWIDTH, SampledLoop
from codrl_mj.actuators.shaft import TemperatureRises, StepAverages, Shaft, Winding
from codrl_mj.fields import part


class State(NamedTuple):
    """What the drive remembers."""

    current: float
    """Motor current [A]."""
    integral: float
    """The controller's integral [V]."""
    pending: float
    """Voltage [V] that a delayed loop applies in the next sample."""
    winding_rise: float
    """How much warmer [K] the winding is than the housing."""
    housing_rise: float
    """How much warmer [K] the housing is than the surroundings."""
    acceleration: float
    """What the torque delivered in the last step did to the rotor's speed [rad/s^2]."""
    speed: float
    """Speed [rad/s] of the rotor at its beginning."""
    external_acceleration: float
    """Acceleration [rad/s^2] of the rotor by all but the motor, as it was taken to be."""
    due: float
    """When [s] the next step is to begin; 0 before the first."""


class Signals(NamedTuple):
    """What can be seen of a step."""

    current: float
    """Mean current [A] over the step: times kT, the torque of the motor."""
    reference_current: float
    """Current asked of the loop [A], within its limits."""
    voltage: float
    """Mean terminal voltage [V] over the step."""
    temperature: float
    """Of the winding [degC], at the end of the step."""
    saturated: float
    """1 where any of the three that follow is."""
    voltage_saturated: float
    """1 where the voltage was at the supply's limit in some sample."""
    current_saturated: float
    """1 where more than `max_current` was asked for."""
    temperature_saturated: float
    """1 where more was asked for than takes the winding to `max_temperature`, and less than `max_current` was given."""
    electrical_power: float
    """Mean of voltage times current at the winding's terminals [W]."""
    copper_loss: float
    """Mean heat [W] in the winding, by the square of the current within the samples."""


def limit_current(parameters: Any, timestep: float, heat: TemperatureRises, resistance: float, asked: float) -> float:
    """The current [A] that the loop is given: what is asked for, within `max_current` and what the winding bears."""
    most = parameters.max_current
    if parameters.max_temperature < math.inf and shaft.has_thermal_model(parameters):
        most = min(most, shaft.thermal_limit(parameters, timestep, heat, resistance))
    return min(max(asked, -most), most)


def begin_step(
    parameters: Any, timestep: float, state: Any, inputs: Inputs
) -> tuple[Winding, TemperatureRises, Shaft]:
    """Winding, temperatures and shaft at the beginning of a step, from a state that has the entries of `State`."""
    inertia, external_acceleration = shaft.inertia_of(parameters, inputs.inertia), 0.0
    if state.due > 0.0 and abs(inputs.time - state.due) < 0.5 * timestep and inertia < math.inf:
        external_acceleration = shaft.estimate_external_acceleration(
            timestep, inputs.speed - state.speed, state.acceleration, state.external_acceleration
        )
    moving = Shaft(inertia, external_acceleration, inputs.speed)
    winding = Winding(state.current, state.integral, state.pending)
    return winding, TemperatureRises(state.winding_rise, state.housing_rise), moving


def end_step(
    parameters: Any,
    timestep: float,
    time: float,
    heat: TemperatureRises,
    resistance: float,
    winding: Winding,
    moving: Shaft,
    means: StepAverages,
) -> tuple[tuple[float, float, float, float, float, float, float, float, float], float]:
    """The entries of `State` after a step, from temperatures and shaft at its beginning, and how warm the winding is.

    The mean current heats.
    """
    if shaft.has_thermal_model(parameters):
        heat = shaft.rises_after(parameters, timestep, heat, resistance * means.current * means.current)
    own = means.torque / moving.inertia
    kept = winding.current, winding.integral, winding.pending, heat.winding, heat.housing
    return (*kept, own, moving.speed, moving.external_acceleration, time + timestep), shaft.temperature_of(
        parameters, heat
    )


def _advance(
    parameters: Any, timestep: float, state: State, inputs: Inputs, closed: bool
) -> tuple[State, float, Signals]:
    """A step of a drive that a torque is asked of or, where the loop is not `closed`, a voltage: kT for a volt."""
    asked = inputs.desired_torque / parameters.torque_constant
    winding, heat, moving = begin_step(parameters, timestep, state, inputs)
    resistance = shaft.resistance_at(parameters, shaft.temperature_of(parameters, heat))
    reference = limit_current(parameters, timestep, heat, resistance, asked) if closed else asked
    samples = max(int(timestep * parameters.sample_rate + 0.5), 1)
    winding, _, means = shaft.advance_motor(
        parameters, resistance, timestep, samples, winding, moving, closed, reference
    )
    after, temperature = end_step(
        parameters, timestep, inputs.time, heat, resistance, winding, moving, means
    )
    shown = reference if closed else means.current
    less, warm = reference != asked, abs(reference) < parameters.max_current
    signals = Signals(
        means.current,
        shown,
        means.voltage,
        temperature,
        1.0 if means.saturated > 0.0 or less else 0.0,
        1.0 if means.saturated > 0.0 else 0.0,
        1.0 if less and not warm else 0.0,
        1.0 if less and warm else 0.0,
        means.power,
        means.heat,
    )
    return State(*after), means.torque, signals


def advance(
    parameters: Any, timestep: float, state: State, inputs: Inputs
) -> tuple[State, float, Signals]:
    """Advance winding, loop and shaft by one mechanical step [s]; speed and inertia of the inputs are the rotor's."""
    return _advance(parameters, timestep, state, inputs, True)


def observe(
    parameters: Any,  # noqa: ARG001
    timestep: float,  # noqa: ARG001
    signals: Signals,
    inputs: Inputs,  # noqa: ARG001
) -> tuple[float, float]:
    """The mean current [A] of the last step, which is what a drive reports, and its reference."""
    return signals.current, signals.reference_current


@dataclasses.dataclass(frozen=True)
class Drive(ActuatorModel):
    """A motor with its gear, the drive's current loop and the supply: a bench motor.

    Raises:
        ValueError: a field is out of bounds.
    """

    family: ClassVar[str] = "drive"
    State: ClassVar[type] = State
    Signals: ClassVar[type] = Signals
    SIGNAL_UNITS: ClassVar[Mapping[str, str]] = {
        "current": "A",
        "reference_current": "A",
        "voltage": "V",
        "temperature": "degC",
        **dict.fromkeys(("voltage_saturated", "current_saturated", "temperature_saturated"), "1"),
        **dict.fromkeys(("electrical_power", "copper_loss"), "W"),
    }
    OBSERVED: ClassVar[tuple[str, ...]] = ("current", "reference_current")
    INERTIA: ClassVar[bool] = True
    CLOSED: ClassVar[bool] = True
    """Whether a current loop is closed around the winding."""
    advance: ClassVar[Callable[..., Any]] = staticmethod(advance)
    observe: ClassVar = staticmethod(observe)

    motor: GearMotor = GearMotor()
    """The motor and its gear."""
    controller: SampledLoop = SampledLoop()
    """The current loop."""
    supply: Supply | None = part(Supply(voltage=24.0))
    """What feeds the drive; None: 24 V without a resistance."""

    @classmethod
    def from_motor_parameters(cls, numbers: Any) -> "Drive":
        """A drive for a motor of `codrl_mj.catalogue.MotorParameters`: its voltage (or 24 V), its peak current."""
        most, voltage = numbers.max_current, numbers.voltage
        loop = SampledLoop() if most is None else SampledLoop(max_current=most)
        return cls(GearMotor.from_motor_parameters(numbers), loop, None if voltage is None else Supply(voltage))

    @property
    def arm_radius(self) -> float:
        """Arm [m] between the rotor and the load: the gear is part of it."""
        return self.motor.arm_radius / self.motor.gear_ratio

    @property
    def additions(self) -> JointAdditions:
        """Rotor inertia and friction, seen from the load."""
        arm, motor = self.arm_radius, self.motor
        return JointAdditions(
            motor.rotor_inertia / (arm * arm),
            motor.viscous_friction / (arm * arm),
            motor.coulomb_friction / arm,
        )

    @property
    def back_emf_damping(self) -> float:
        """As `ActuatorModel.back_emf_damping`: kT*kE/R, seen from the load through a gear that loses some torque."""
        motor = self.motor
        braking = motor.torque_constant * motor.back_emf_constant / motor.resistance
        return motor.gear_efficiency * braking / self.arm_radius**2

    @property
    def winding(self) -> tuple[float, float]:
        """Resistance [ohm] and inductance [H]."""
        return self.motor.resistance, self.motor.inductance

    @property
    def voltage_limit(self) -> float:
        """The supply's voltage [V]."""
        return 24.0 if self.supply is None else self.supply.voltage

    @property
    def supply_resistance(self) -> float:
        """The supply's resistance [ohm], by which its voltage sags under a current."""
        return 0.0 if self.supply is None else self.supply.resistance

    @property
    def assumed(self) -> str:
        """As `ActuatorModel.assumed`: the supply, the largest current, the inertia of the rotor."""
        motor = self.motor
        alike = 0.5 <= motor.back_emf_constant / motor.torque_constant <= 2.0
        missing = {
            f"supply.voltage = {self.voltage_limit:g} V": (
                self.supply is None or math.isinf(self.supply.voltage)
            ),
            "controller.max_current = inf": math.isinf(self.controller.max_current),
            "motor.rotor_inertia = 0": motor.rotor_inertia == 0.0,
        }
        for name in (
            "torque_constant",
            "back_emf_constant",
        ):  # of another motor: the two are equal but for losses
            value = getattr(motor, name)
            missing[f"motor.{name} = {value:g}, a default"] = not alike and value == getattr(
                GearMotor, name
            )
        told = ", ".join(text for text, is_missing in missing.items() if is_missing)
        return f"assumed, for none is given: {told}" if told else ""

    @classmethod
    def from_parameter_values(cls, numbers: Any, arm_radius: float = 1.0) -> Any:
        """As `ActuatorModel.from_parameter_values`: the arm is that between rotor and load, the gear among the numbers."""
        family: Any = cls
        return super().from_parameter_values(
            numbers, arm_radius * parameters_type(family)(*numbers).gear_ratio
        )

    def commands(self) -> Mapping[str, Command]:
        """A reference `current` [A] within `max_current`, or the terminal `voltage` [V]."""
        limit, torque = self.controller.max_current, self.motor.torque_constant
        fixed = dict.fromkeys(
            ("motor.torque_constant", *ARM), "it would change what an action means"
        )
        driven = VoltageDrive(self.motor, self.controller, self.supply)
        past = ["motor.max_temperature", *(f"controller.{name}" for name in _PAST_THE_LOOP)]
        return {
            "current": Command("A", self, torque, limit if math.isfinite(limit) else None, fixed),
            "voltage": Command(
                "V",
                driven,
                torque,
                self.voltage_limit,
                fixed | dict.fromkeys(past, "the command goes past the loop"),
            ),
        }

    def check(self, timestep: float) -> None:
        """Refuse a step without a whole number of samples, and a loop that is unstable.

        Raises:
            ValueError: with the numbers and a remedy.
        """
        controller, samples = self.controller, timestep * self.controller.sample_rate
        if abs(samples - round(samples)) > 1e-6 * samples or samples < 0.5:
            nearest = max(round(samples), 1) / timestep
            raise ValueError(
                f"SampledLoop.sample_rate = {controller.sample_rate:g}: a mechanical step of"
                f" {timestep:g} s holds {samples:g} samples, must be a whole number of them; the"
                f" nearest rate is {nearest:.8g} Hz"
            )
        radius = float(_radii(type(self), np.array([self.parameter_values]))[0])
        if not radius < 1.0:
            raise UnstableError(
                f"actuator: the current loop is unstable: spectral radius {radius:.4g} over a"
                f" sample, must be < 1. Lower controller.kp = {controller.kp:g} and controller.ki ="
                f" {controller.ki:g}, or leave both 0 to have them designed; lower"
                " supply.resistance; or pass allow_unstable=True to study it as it is"
            )

    def check_shaft(self, timestep: float, inertia: float, held: bool = False) -> None:
        """Refuse a speed that the back-EMF of a saturated motor makes unstable; warn where it would be wrong.

        Raises:
            UnstableError: with the number and a remedy.
        """
        rotor, told = self.motor.rotor_inertia, self.motor.load_inertia
        held = held or math.isinf(told)
        if 0.0 < told < math.inf:
            inertia = rotor + told / self.motor.gear_ratio**2
        braking = self.motor.torque_constant * self.motor.back_emf_constant / self.motor.resistance
        samples = 1.0 if held else max(round(timestep * self.controller.sample_rate), 1)
        share = timestep / samples * braking / inertia
        remedy = "raise controller.sample_rate"
        if held:
            remedy = (
                "shorten the step"
                if told == 0.0
                else "leave motor.load_inertia 0, so that the speed is followed"
            )
        text = (
            f"motor.rotor_inertia = {rotor:g}: the back-EMF of a saturated motor takes {share:.3g}"
            f" of the rotor's speed in {timestep / samples:g} s over which that is held"
        )
        if share >= 2.0:
            raise UnstableError(
                f"{text}, must be < 2; {remedy}, give the rotor its inertia (it moves {inertia:.3g}"
                " kg*m^2 in all), shorten the step, or pass allow_unstable=True to study it as"
                " it is"
            )
        if share > 0.5:
            warnings.warn(
                f"{text}: above 0.5 it is wrong, above 1 it rings; {remedy}", stacklevel=2
            )
        elif share * samples > 3.0:
            warnings.warn(
                f"motor.rotor_inertia = {rotor:g}: the back-EMF of a saturated motor takes"
                f" {share * samples:.3g} of the rotor's speed in a step of {timestep:g} s. That is"
                " followed on a free shaft; at a stop, under friction or beside other joints the"
                " torque comes as many steps late; shorten the step",
                stacklevel=2,
            )

    @classmethod
    def instability(cls, numbers: np.ndarray, timestep: float) -> np.ndarray:
        """The spectral radius of the loop over a sample; infinite where a step holds no whole number of samples.

        And where two fields are together what their class refuses.
        """
        columns = stability.parameter_columns(cls, numbers)
        samples = timestep * columns.sample_rate
        possible = (abs(samples - np.round(samples)) <= 1e-6 * samples) & (samples >= 0.5)
        # what `GearMotor` and `SampledLoop` refuse of fields together
        possible &= columns.max_temperature > columns.ambient_temperature
        possible &= columns.bandwidth <= columns.sample_rate / (2.0 * math.pi)
        possible &= np.isinf(columns.max_temperature) | (
            columns.thermal_resistance_winding + columns.thermal_resistance_housing > 0.0
        )
        possible &= (
            1.0 + columns.resistance_coefficient * (columns.ambient_temperature - 25.0) > 0.0
        )
        return np.where(possible, _radii(cls, numbers), np.inf)


ARM = ("motor.gear_ratio", "motor.arm_radius")
"""Fields that change what a torque at the rotor is at the joint."""
_PAST_THE_LOOP = ("bandwidth", "kp", "ki", "anti_windup", "bemf_compensation", "max_current")
"""What of a loop does not count where the agent commands the voltage."""


def _advance_driven(
    parameters: Any, timestep: float, state: State, inputs: Inputs
) -> tuple[State, float, Signals]:
    """`advance` past the loop; the current asks for itself, as an agent that commands voltages desires what follows."""
    return _advance(parameters, timestep, state, inputs, False)


@dataclasses.dataclass(frozen=True)
class VoltageDrive(Drive):
    """A drive under commanded terminal voltage; a desired torque of kT stands for a volt."""

    family: ClassVar[str] = ""
    is_torque_controlled: ClassVar[bool] = False
    CLOSED: ClassVar[bool] = False
    advance: ClassVar = staticmethod(_advance_driven)


def _radii(cls: Any, numbers: np.ndarray) -> np.ndarray:
    """Spectral radii over one sample, unsaturated and saturated, shape (m,)."""
    columns = stability.parameter_columns(cls, numbers)
    sample_time, resistance = 1.0 / columns.sample_rate, columns.resistance
    x = resistance * sample_time / columns.inductance
    decay = np.exp(-x)
    share = np.where(columns.bandwidth > 0.0, columns.bandwidth * sample_time, DEFAULT_BANDWIDTH)
    design = np.vectorize(sampled.designed_gains, otypes=[float, float])
    gains = design(
        resistance, columns.inductance, sample_time, 2.0 * math.pi * share * columns.sample_rate
    )
    designed = (columns.kp == 0.0) & (columns.ki == 0.0)
    kp = np.where(designed, gains[0], columns.kp)
    ki = np.where(designed, gains[1], columns.ki * sample_time)
    if not cls.CLOSED:
        kp, ki = 0.0 * kp, 0.0 * ki
    effect = (1.0 - decay) / resistance  # of a volt, in a sample
    nothing, one, late = np.zeros(len(numbers)), np.ones(len(numbers)), columns.delayed != 0.0
    integrates = ki > 0.0  # else the integral is no part of the loop
    voltage = -(kp + ki), np.where(integrates, one, 0.0), nothing  # of (current, integral, pending)
    rows = [
        [
            decay + np.where(late, 0.0, effect * voltage[0]),
            np.where(late, 0.0, effect * voltage[1]),
            late * effect,
        ],
        [-ki, np.where(integrates, one, 0.0), nothing],
        [late * voltage[0], late * voltage[1], nothing],
    ]
    matrices = np.array(rows).transpose(2, 0, 1)
    radii = np.abs(np.linalg.eigvals(matrices).astype(np.complex128)).max(axis=1)
    # at its limit the voltage follows the current through the supply's resistance
    return np.maximum(radii, np.abs(decay - effect * columns.supply_resistance))
