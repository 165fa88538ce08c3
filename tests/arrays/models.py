"""Models and motors of the tests of other simulators, and their motion in our engine."""

from pathlib import Path

import gymnasium
import mujoco
import numpy as np

import codrl_mj
from codrl_mj.actuators import Servo, ServoLoop, resolve

PENDULUM = """
<mujoco model="pendulum">
  <option timestep="0.002" integrator="{integrator}"/>
  <worldbody>
    <body name="rod">
      <joint name="hinge" axis="0 1 0" damping="0.01"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="0.5" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <actuator>
    <motor name="motor" joint="hinge" ctrlrange="-5 5" ctrllimited="true" forcerange="-4 4" forcelimited="true"/>
  </actuator>
</mujoco>
"""
TWO_JOINTS = """
<mujoco model="two joints">
  <option timestep="0.002" integrator="{integrator}"/>
  <worldbody>
    <body>
      <joint name="a" axis="0 1 0" damping="0.01" {joint}/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="0.5" contype="0" conaffinity="0"/>
      <body pos="0 0 -0.3">
        <joint name="b" axis="0 1 0" damping="0.01"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="0.3" contype="0" conaffinity="0"/>
      </body>
    </body>
  </worldbody>
  <actuator><{first}/><motor name="second" joint="b" gear="2"/></actuator>
</mujoco>
"""
CHEETAH = Path(gymnasium.__file__).parent / "envs/mujoco/assets/half_cheetah.xml"
STEPS = 500
CATALOGUE_MOTOR = resolve("maxon-ec45-flat-50w", None, "the test").replaced(
    {
        "motor.gear_ratio": 20.0,
        "motor.gear_efficiency": 0.85,
        "controller.max_current": 6.0,
    }
)


def pendulum(integrator="Euler"):
    return mujoco.MjSpec.from_string(PENDULUM.format(integrator=integrator))


def two_joints(integrator="Euler", first='motor name="first" joint="a"', joint=""):
    text = TWO_JOINTS.format(integrator=integrator, first=first, joint=joint)
    return mujoco.MjSpec.from_string(text)


def cheetah(timestep=0.002):
    spec = mujoco.MjSpec.from_file(str(CHEETAH))
    spec.option.timestep = timestep
    return spec


def servo():
    motor = CATALOGUE_MOTOR.replaced({"motor.gear_ratio": 10.0})
    loop = ServoLoop(servo_rate=1000.0, position_gain=8.0, velocity_gain=1.0)
    return Servo(motor.motor, motor.controller, motor.supply, loop)


def square_waves(num_steps, num_worlds, num_actuators=1):
    """Return commands, shape (steps, worlds, actuators), some beyond the limits of a control."""
    world = np.arange(num_worlds)[:, np.newaxis]
    size = 2.0 + 4.0 * (world % 7) / 6
    rate = 2.0 * np.pi * (0.7 + 0.1 * (world % 5)) * 0.002
    steps = np.arange(num_steps)[:, np.newaxis, np.newaxis] + 37 * np.arange(num_actuators)
    return np.where(np.sin(rate * steps) >= 0.0, size, -size)


def our_motion(models, commands, starts=None, reset_at=None, reset_worlds=()):
    """Return the positions in our engine, shape (steps, worlds, nq).

    Args:
        models: a compiled model for each world.
        commands: shape (steps, worlds, actuators).
        starts: initial positions, shape (worlds, nq).
        reset_at: step before which some worlds are reset.
        reset_worlds: these worlds.
    """
    positions = np.zeros((*commands.shape[:2], models[0].nq))
    for world, model in enumerate(models):
        data = mujoco.MjData(model)
        if starts is not None:
            data.qpos[:] = starts[world]
        for step, rows in enumerate(commands):
            if step == reset_at and world in reset_worlds:
                mujoco.mj_resetData(model, data)
            data.ctrl[:] = rows[world]
            mujoco.mj_step(model, data)
            positions[step, world] = data.qpos
    return positions


def with_our_motors(spec, actuators):
    return codrl_mj.add_motors(spec, actuators).compile() if actuators else spec.copy().compile()
