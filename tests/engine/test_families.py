"""Families in the callback: built-in and custom ones give the bits of their Python functions."""

import dataclasses
import math
from typing import NamedTuple

import mujoco
import numpy as np
import pytest

from codrl_mj import engine
from codrl_mj.actuators import (
    ActuatorModel,
    Drive,
    GearMotor,
    Inputs,
    Lag,
    PwmLoop,
    PwmServo,
    SampledLoop,
    Servo,
    ServoLoop,
    Supply,
    TorqueSpeed,
    family_id,
    parameters_type,
)
from codrl_mj.actuators.noise import standard_normal
from codrl_mj.engine.families import (
    SLOT_HEADER_SIZE,
    SlotHeader,
    loaded_families,
    signals_offset,
    slot_size,
    user_header,
)
from codrl_mj.fields import flag, integer, optional_nested, real
from codrl_mj.physics import (
    AnalyticPhysics,
    MujocoPhysics,
    SimulationConfig,
    install_callbacks,
    motors,
)
from codrl_mj.physics.mjcf import configure_actuator
from codrl_mj.tasks import TASKS
from tests.engine.models import FULL, changed, controls, rotor, rotor_spec, trajectory
from tests.tasks.faces import every_rebuilt

KEY = 2.0**52 + 12345.0


class Memory(NamedTuple):
    """State of a spring."""

    filtered: float
    steps: float


class Seen(NamedTuple):
    """Signals of a spring."""

    heat: float
    draw: float
    saturated: float


@dataclasses.dataclass(frozen=True)
class Coil:
    """Part of a spring."""

    stiffness: float = real(0.7, minimum=0.0)
    turns: int = integer(3, minimum=1)


@dataclasses.dataclass(frozen=True)
class Brake:
    """Optional part of a spring."""

    drag: float = real(0.0, minimum=0.0)


def _softened(torque, limit):
    return limit * math.tanh(torque / limit)


def _advance(parameters, timestep, state, inputs):
    draw = standard_normal(inputs.noise_key, int(inputs.time / timestep + 0.5), 7)
    target = (
        inputs.desired_torque - parameters.stiffness * math.sin(inputs.position) * parameters.turns
    )
    target = target - parameters.brake_drag * inputs.speed * abs(inputs.speed) + 0.01 * draw
    filtered = state.filtered + (target - state.filtered) * timestep / (timestep + 0.03)
    if parameters.soft:
        torque = _softened(filtered, parameters.limit)
    else:
        torque = min(max(filtered, -parameters.limit), parameters.limit)
    saturated = 1.0 if abs(filtered) > parameters.limit else 0.0
    return Memory(filtered, state.steps + 1.0), torque, Seen(torque * inputs.speed, draw, saturated)


@dataclasses.dataclass(frozen=True)
class Spring(ActuatorModel):
    """Custom family with parts, flags, integers, noise, a helper, and all inputs in use."""

    family = "spring"
    State = Memory
    Signals = Seen
    advance = staticmethod(_advance)

    coil: Coil = Coil()
    brake: Brake | None = optional_nested(Brake())
    limit: float = real(0.5, above=0.0)
    soft: bool = flag(False)
    arm_radius: float = real(0.4, above=0.0)


@dataclasses.dataclass(frozen=True)
class Bare(ActuatorModel):
    """Smallest possible family: without fields, states and signals."""

    @staticmethod
    def advance(parameters, timestep, state, inputs):  # noqa: ARG004
        return state, 0.5 * inputs.desired_torque, state


class Endless(NamedTuple):
    """Signal that is infinite; the engine multiplies the last one by a gain of 0."""

    limit: float


@dataclasses.dataclass(frozen=True)
class Boundless(Bare):
    """Family with an infinite signal."""

    Signals = Endless

    @staticmethod
    def advance(parameters, timestep, state, inputs):  # noqa: ARG004
        return state, 0.5 * inputs.desired_torque, Endless(math.inf)


SPRINGS = [
    Spring(),
    Spring(Coil(0.3, 5), Brake(0.2), limit=0.3),
    Spring(brake=Brake(0.05), soft=True, arm_radius=1.3),
]
ALL = [
    *SPRINGS,
    Bare(),
    Boundless(),
    Lag(0.07),
    Lag(0.02, 0.033),
    Lag(0.0, 0.08),
    TorqueSpeed(0.4, 3.0, 0.3),
    Drive(
        GearMotor(torque_constant=0.5, gear_ratio=2.0),
        SampledLoop(10e3, max_current=0.3),
        Supply(2.0),
    ),
    Drive(
        GearMotor(torque_constant=0.5),
        SampledLoop(10e3, anti_windup="clamping", delayed=True),
        Supply(2.0, 0.5),
    ),
    Drive(
        GearMotor(
            torque_constant=0.5,
            gear_ratio=2.0,
            gear_efficiency=0.8,
            stribeck_friction=0.01,
            thermal_resistance_winding=50.0,
        ),
        SampledLoop(10e3, deadband=0.1, max_current=0.3),
        Supply(2.0),
    ),
    Drive(GearMotor(torque_constant=0.5), SampledLoop(10e3), Supply(2.0))
    .commands()["voltage"]
    .actuator,
    Servo(
        GearMotor(torque_constant=0.5, gear_ratio=2.0),
        SampledLoop(10e3),
        Supply(2.0),
        ServoLoop(servo_rate=500.0),
    ),
    Servo(
        loop=ServoLoop(
            "velocity", 50.0, velocity_integral_gain=2.0, inertia_feed_forward=0.01, max_torque=0.3
        )
    ),
    PwmServo(
        GearMotor(torque_constant=0.5, gear_ratio=2.0, gear_efficiency=0.8),
        PwmLoop(
            position_gain=2.0,
            integral_gain=1.0,
            servo_rate=500.0,
            max_duty=0.5,
            encoder_counts=4096.0,
            max_velocity=3.0,
            max_acceleration=30.0,
        ),
        Supply(2.0, 0.2),
    ),
    PwmServo(
        loop=PwmLoop(
            derivative_gain=0.01,
            deadband=0.01,
            start_duty=0.05,
            command_rate=50.0,
            command_delay=0.03,
            command_jitter=0.004,
        )
    ),
    FULL,
    dataclasses.replace(
        changed(FULL, current_noise=0.2, current_bias=0.1), supply=Supply(5.0, 0.7)
    ),
    FULL.commands()["voltage"].actuator,
]
STEPS = 80


@pytest.fixture
def _families(installed):
    for family in {type(actuator) for actuator in ALL}:
        engine.load_family(family)


pytestmark = pytest.mark.usefixtures("_families")


@pytest.mark.parametrize("integrator", ["Euler", "implicitfast", "RK4"])
@pytest.mark.parametrize("actuator", ALL, ids=lambda actuator: type(actuator).__name__)
def test_a_family_runs_in_the_callback_bit_for_bit_as_in_python(actuator, integrator):
    model, family = rotor(actuator, integrator=integrator), type(actuator)
    data, parameters = mujoco.MjData(model), parameters_type(family)(*actuator.parameter_values)
    states, shown = len(family.State._fields), signals_offset(family)
    data.act[SlotHeader._fields.index("noise_key")] = KEY
    state, timestep, gear = (
        family.State(*[0.0] * states),
        model.opt.timestep,
        model.actuator_gear[0, 0],
    )
    assert gear == 1.0 / actuator.arm_radius
    torques = []
    for (ctrl,) in controls(STEPS, size=0.6):
        mujoco.mj_fwdPosition(model, data)
        inertia = 1.0 / (gear * gear * data.qLDiagInv[0]) if family.INERTIA else math.inf
        inputs = Inputs(ctrl, gear * data.qpos[0], gear * data.qvel[0], data.time, KEY, inertia)
        data.ctrl[:] = ctrl
        mujoco.mj_step(model, data)
        state, torque, signals = family.advance(parameters, timestep, state, inputs)
        candidate = data.act[SLOT_HEADER_SIZE + states : shown]
        np.testing.assert_array_equal(candidate, state)
        np.testing.assert_array_equal(data.act[shown:], [*signals, 0.0])
        assert data.act[SlotHeader._fields.index("torque")] == torque
        assert data.actuator_force[0] == torque
        torques.append(torque)
    assert np.ptp(torques) > 0.05
    assert len(data.act) == slot_size(family)


@pytest.mark.parametrize(
    "change",
    [
        {"coil": Coil(stiffness=0.1)},
        {"coil": Coil(turns=1)},
        {"brake": Brake(0.3)},
        {"limit": 0.1},
        {"soft": True},
        {"arm_radius": 0.8},
    ],
)
def test_every_field_of_a_custom_family_has_an_effect(change):
    ends = [
        trajectory(rotor(dataclasses.replace(Spring(), **values)), controls(STEPS, size=0.6))[-1]
        for values in ({}, change)
    ]
    assert np.abs(ends[1][1:3] - ends[0][1:3]).max() > 1e-6


@pytest.mark.parametrize("actuator", ALL, ids=lambda actuator: type(actuator).__name__)
def test_a_motor_is_read_back_from_the_model_unchanged(actuator):
    ((index, motor),) = motors(rotor(actuator)).items()
    assert index == 0
    assert type(motor) is type(actuator)
    assert motor.parameter_values == actuator.parameter_values
    assert motor.arm_radius == pytest.approx(actuator.arm_radius, rel=1e-15)


def hinges(*actuators):
    """Return a model with a separate hinge for each actuator."""
    spec = mujoco.MjSpec.from_string(
        "<mujoco><option timestep='0.01'><flag contact='disable'/></option><worldbody>"
        + "".join(
            f"<body><joint name='{index}'/><geom size='.1' pos='.2 0 .1'/></body>"
            for index in range(len(actuators))
        )
        + "</worldbody></mujoco>"
    )
    for index, actuator in enumerate(actuators):
        configure_actuator(
            spec.add_actuator(trntype=mujoco.mjtTrn.mjTRN_JOINT, target=str(index)), actuator, None
        )
    return spec.compile()


def test_families_in_a_model_do_not_affect_each_other():
    together, inputs = hinges(*ALL), controls(STEPS, len(ALL), size=0.6)
    assert list(motors(together)) == list(range(len(ALL)))
    data = mujoco.MjData(together)
    trajectory(together, inputs, data)
    for index, actuator in enumerate(ALL):
        model = hinges(actuator)
        single, start = mujoco.MjData(model), together.actuator_actadr[index]
        trajectory(model, inputs[:, [index]], single)
        np.testing.assert_allclose(
            data.act[start : start + model.na], single.act, rtol=1e-9, atol=1e-12
        )


@every_rebuilt
def test_both_physics_give_a_family_the_same_inputs(task):
    """The spring's torque depends on position, speed and time."""
    definition = TASKS[task]
    actuators = [dataclasses.replace(SPRINGS[1], limit=10.0)]
    start = np.full(len(definition.state_names), 0.05)
    rows = []
    for kind in (MujocoPhysics, AnalyticPhysics):
        physics = kind(SimulationConfig(definition, actuators, 4))
        physics.reset(start, KEY)
        for force in controls(10, size=definition.max_force)[:, 0]:
            physics.step(float(force))
        rows.append([*physics.trace[-1, 0], *physics.state])
    np.testing.assert_allclose(*rows, rtol=0, atol=1e-9)


# -- the table -------------------------------------------------------------------------------------


def test_a_model_compiles_its_families_on_installation():
    @dataclasses.dataclass(frozen=True)
    class Late(ActuatorModel):
        @staticmethod
        def advance(parameters, timestep, state, inputs):  # noqa: ARG004
            return state, 2.0 * inputs.desired_torque, state

    spec = rotor_spec()
    configure_actuator(spec.actuator("motor"), Late(), None)
    model = spec.compile()
    with pytest.raises(
        ValueError, match=r"motor: .* is not known in this process: import its module"
    ):
        motors(model)
    data = mujoco.MjData(model)
    data.ctrl[:] = 0.25
    mujoco.mj_step(model, data)
    assert data.actuator_force[0] == 0.0
    engine.load_family(Late)
    install_callbacks(model)
    mujoco.mj_step(model, data)
    assert data.actuator_force[0] == 0.5


def test_load_family_raises_if_two_families_have_the_same_number(monkeypatch):
    @dataclasses.dataclass(frozen=True)
    class Other(Spring):
        pass

    monkeypatch.setattr(
        "codrl_mj.engine.families.family_id",
        lambda family: family_id(Spring),  # noqa: ARG005
    )
    with pytest.raises(
        ValueError,
        match=f"Other and .*:Spring have the same number {family_id(Spring)}: rename one",
    ):
        engine.load_family(Other)
    before = loaded_families()
    assert Spring in before
    assert Other not in before
    # A repeated call changes nothing.
    engine.load_family(Spring)
    assert loaded_families() == before


def test_a_familys_number_is_unique_and_survives_an_xml_file(tmp_path):
    numbers = [family_id(type(actuator)) for actuator in ALL]
    assert len(set(numbers)) == len({type(actuator) for actuator in ALL})
    assert user_header(Spring)[2] == family_id(Spring)
    spec = rotor_spec(Spring())
    spec.compile()
    path = tmp_path / "model.xml"
    path.write_text(spec.to_xml())
    (motor,) = motors(mujoco.MjModel.from_xml_path(str(path))).values()
    assert motor == Spring()
