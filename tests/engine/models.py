"""Small models with our motors."""

import dataclasses

import mujoco
import numpy as np

from codrl_mj.actuators import CurrentLoop, DCMotorActuator, Motor
from codrl_mj.engine.families import SLOT_HEADER_SIZE, SlotHeader, signals_offset
from codrl_mj.physics.mjcf import configure_actuator
from codrl_mj.user_code import asset_path

FULL = DCMotorActuator(
    Motor(
        resistance=1.2, inductance=0.05, torque_constant=0.8, back_emf_constant=0.7, arm_radius=0.5
    ),
    CurrentLoop(
        kp=2.0,
        ki=5.0,
        kd=1e-3,
        kff=0.4,
        max_voltage=4.0,
        substeps=2,
        integral_leak=0.3,
        derivative_time_constant=0.01,
    ),
)
"""Actuator that uses every feature."""


TICK = SlotHeader._fields.index("state_time")
_SIZE = len(DCMotorActuator.State._fields)
STATE = [SLOT_HEADER_SIZE + _SIZE + entry for entry in range(_SIZE)]
"""Entries of `data.act` with a current loop's state of the last step: current, integral, error."""
CURRENT = STATE[0]
VOLTAGE = signals_offset(DCMotorActuator) + DCMotorActuator.Signals._fields.index("voltage")


def changed(actuator, **fields):
    """Return the actuator with other values of some fields of its motor or controller."""
    motor = {name: value for name, value in fields.items() if hasattr(actuator.motor, name)}
    loop = {name: value for name, value in fields.items() if name not in motor}
    return DCMotorActuator(
        dataclasses.replace(actuator.motor, **motor),
        dataclasses.replace(actuator.controller, **loop),
    )


_ROTOR = """
<mujoco>
  <compiler autolimits="false"/>
  <option timestep="0.01"/>
  <worldbody>
    <body name="rotor">
      <joint name="hinge" axis="0 1 0"/>
      <inertial pos="0.1 0 -0.2" mass="0.5" diaginertia="0.05 0.05 0.05"/>
    </body>
  </worldbody>
</mujoco>
"""


def add_motor(spec, joint, actuator, max_force=None, **fields):
    """Add our motor to a joint of the spec."""
    driver = spec.add_actuator(trntype=mujoco.mjtTrn.mjTRN_JOINT, target=joint, **fields)
    configure_actuator(driver, actuator, max_force)
    return driver


def rotor_spec(actuator=FULL, *, max_force=None, integrator="Euler"):
    """Return the spec of an eccentric rotor on a hinge under gravity, with our motor."""
    spec = mujoco.MjSpec.from_string(_ROTOR)
    spec.option.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}")
    add_motor(spec, "hinge", actuator, max_force, name="motor")
    return spec


def rotor(*arguments, **options):
    """Return the compiled `rotor_spec`."""
    return rotor_spec(*arguments, **options).compile()


def cartpole(actuator, *, integrator="Euler"):
    """Return the model of the cart-pole asset with another actuator or integrator."""
    spec = mujoco.MjSpec.from_file(str(asset_path("cartpole.xml")))
    spec.option.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}")
    configure_actuator(spec.actuator("motor"), actuator, 10.0)
    return spec.compile()


def controls(steps, nu=1, seed=0, size=1.0):
    """Return random controls, each held for five steps."""
    generator = np.random.default_rng(seed)
    return np.repeat(generator.uniform(-size, size, (steps // 5 + 1, nu)), 5, axis=0)[:steps]


def full_state(model, data):
    """Return time, positions, velocities and activations: the state of an episode."""
    state = np.empty(mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS))
    mujoco.mj_getState(model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    return state


def trajectory(model, inputs, data=None, before_step=None):
    """Return the full state after each step with given controls.

    `before_step(data, index)` is called before each step.
    """
    data = mujoco.MjData(model) if data is None else data
    states = []
    for index, ctrl in enumerate(inputs):
        data.ctrl[:] = ctrl
        if before_step is not None:
            before_step(data, index)
        mujoco.mj_step(model, data)
        states.append(full_state(model, data))
    return np.array(states)
