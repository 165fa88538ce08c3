"""Loops over positions and speeds with the mechanical step: closed forms and oscillations."""

import dataclasses
import math
from typing import ClassVar

import mujoco
import numpy as np
import pytest

import codrl_mj
from codrl_mj.actuators import (
    ActuatorModel,
    GearMotor,
    Inputs,
    SampledLoop,
    Servo,
    ServoLoop,
    Supply,
    TorqueSpeed,
    UnstableError,
)
from codrl_mj.actuators.model import Empty
from codrl_mj.fields import real

MOTOR = GearMotor(0.5, 2e-4, 0.05, 0.05, rotor_inertia=1e-6, gear_ratio=20.0)


def servo(**loop):
    return Servo(
        MOTOR,
        SampledLoop(20e3, max_current=20.0),
        Supply(24.0),
        ServoLoop(position_gain=10.0, **loop),
    )


def pendulum(actuator, **more):
    action = "position" if actuator.loop.controls == "position" else "velocity"
    return codrl_mj.make("pendulum", actuator=actuator, action=action, **more)


def hinge(inertia, timestep=0.01):
    """Return the spec of a hinge without gravity."""
    spec = mujoco.MjSpec()
    spec.option.timestep, spec.option.gravity, body = timestep, [0.0] * 3, spec.worldbody.add_body()
    body.explicitinertial, body.mass, body.inertia = True, 1.0, [inertia] * 3
    body.add_joint(name="shaft", axis=[0.0, 0.0, 1.0])
    spec.add_actuator(name="it", target="shaft", trntype=mujoco.mjtTrn.mjTRN_JOINT).set_to_motor()
    return spec


def held(env, steps=100):
    """Return the start [rad], and deviations [rad] and currents [A] in the last second there."""
    env.reset(seed=3)
    start, rows = env.unwrapped.state[0], []
    for _ in range(steps):
        info = env.step(np.array([start], np.float32))[4]
        rows.append((env.unwrapped.state[0] - start, info["current"]))
    return start, np.array(rows[-20:]).T


@pytest.mark.parametrize("timestep", [None, 0.01])
def test_a_servo_holds_a_rod_at_the_tasks_default_step(timestep):
    """The rod sags by its weight's torque/(position_gain*velocity_gain)."""
    more = {} if timestep is None else {"timestep": timestep}
    start, (off, current) = held(pendulum(servo(velocity_gain=12.0), **more))
    weight = 5.0 * math.sin(start + off[-1])
    assert off == pytest.approx(weight / (10.0 * 12.0), abs=1e-4)
    assert current == pytest.approx(-weight / (20.0 * 0.05), abs=2e-3)


def test_a_servo_too_slow_for_its_gain_raises_and_names_a_stable_step():
    """At 0.05 s velocity_gain*h/J plus the position's share exceeds its bound of 2."""
    slow = servo(velocity_gain=14.0, servo_rate=20.0)
    with pytest.raises(
        UnstableError, match=r"^motor: the outer loops are .* A shorter step does not help; or pass"
    ):
        pendulum(slow)
    off, _ = held(pendulum(slow, allow_unstable=True))[1]
    assert np.ptp(off) > 0.02
    pendulum(dataclasses.replace(slow, loop=dataclasses.replace(slow.loop, velocity_gain=7.0)))
    fast = servo(velocity_gain=14.0, servo_rate=1000.0)
    with pytest.raises(
        UnstableError,
        match=r"over a mechanical step of 0\.05 s.* step to 0\.025 s, which makes them stable",
    ):
        pendulum(dataclasses.replace(fast, motor=dataclasses.replace(MOTOR, load_inertia=math.inf)))


@dataclasses.dataclass(frozen=True)
class Spring(ActuatorModel):
    """Custom family that closes a loop over position and speed without declaring it."""

    stiffness: float = real(1.0, minimum=0.0)
    damping: float = real(0.0, minimum=0.0)
    dry: float = real(0.0, minimum=0.0)

    @staticmethod
    def advance(parameters, timestep, state, inputs: Inputs):  # noqa: ARG004
        torque = -parameters.stiffness * inputs.position - parameters.damping * inputs.speed
        if inputs.speed != 0.0:
            torque -= parameters.dry * math.copysign(1.0, inputs.speed)
        return Empty(), torque + inputs.desired_torque, Empty()

    State: ClassVar[type] = Empty


@pytest.mark.parametrize("shares", [(4.0, 0.0), (0.0, 2.0), (2.0, 1.0)])
def test_a_custom_family_raises_exactly_if_the_jury_criterion_fails(shares):
    """Held over steps of semi-implicit Euler, h^2*k/J + 2*h*d/J must be below 4."""
    inertia, timestep = 0.02, 0.01
    stiffness, damping = shares[0] * inertia / timestep**2, shares[1] * inertia / timestep
    for factor, refused in ((0.98, False), (1.02, True)):
        spring = Spring(stiffness=factor * stiffness, damping=factor * damping)
        if refused:
            with pytest.raises(
                UnstableError,
                match=r"inertia at its shaft is 0\.02 kg\*m\^2.* Or shorten the step to 0\.005 s",
            ):
                codrl_mj.add_motors(hinge(inertia), {"it": spring})
        else:
            codrl_mj.add_motors(hinge(inertia), {"it": spring})


def test_dry_friction_of_a_custom_family_is_not_a_loop():
    codrl_mj.add_motors(hinge(0.02), {"it": Spring(stiffness=1.0, dry=0.5)})


def test_a_torque_speed_line_that_overshoots_is_refused():
    """The speed swings from 0 to over twice the no-load speed, or reaches the no-load speed."""
    line = TorqueSpeed(stall_torque=1.0, no_load_speed=10.0, max_torque=1.0)
    for inertia, swings in ((0.01 * 0.1 / 1.9, False), (0.01 * 0.1 / 2.1, True)):
        data = mujoco.MjData(
            codrl_mj.add_motors(hinge(inertia), {"it": line}, allow_unstable=True).compile()
        )
        data.ctrl[:], speeds = 1.0, []
        for _ in range(400):
            mujoco.mj_step(data.model, data)
            speeds.append(data.qvel[0])
        assert (np.ptp(speeds[-20:]) > 1.0) == swings
        if swings:
            with pytest.raises(
                UnstableError, match=r"by 2\.1 times its distance .* less than 0\.00952 s"
            ):
                codrl_mj.add_motors(hinge(inertia), {"it": line})
        else:
            codrl_mj.add_motors(hinge(inertia), {"it": line})


@pytest.mark.parametrize(
    "draws", [{"loop.velocity_gain": "uniform(3, 14)"}, {"model.mass.rod": "uniform(0.5, 2)"}]
)
def test_randomization_raises_if_its_range_includes_unstable_motors(draws):
    """Check each extreme value alone, and the worst combination: a gain of 9 on half the mass."""
    slow = servo(velocity_gain=9.0, servo_rate=20.0)
    with pytest.raises(
        ValueError, match=r"^randomize: .* = \S+: motor: the outer loops .* narrow the bounds"
    ):
        pendulum(slow, randomize=draws)
    pendulum(slow, randomize=draws, allow_unstable=True).reset(seed=0)
    half = {name: text.replace("14", "8").replace("0.5", "0.9") for name, text in draws.items()}
    pendulum(slow, randomize=half).reset(seed=0)
    both = {"model.mass.rod": "uniform(0.6, 1)", "loop.velocity_gain": "uniform(3, 10)"}
    with pytest.raises(
        ValueError, match=r"randomize: model\.mass\.rod = 0\.6, loop\.velocity_gain = 10: motor"
    ):
        pendulum(slow, randomize=both)


@pytest.mark.filterwarnings("ignore:motor.rotor_inertia")
def test_randomization_of_motors_in_custom_models_is_checked():
    with pytest.raises(
        ValueError, match=r"^InvertedPendulum-v5: randomize: loop\.velocity_gain = 0\.5: "
    ):
        codrl_mj.make(
            "InvertedPendulum-v5",
            {".*": dataclasses.replace(servo(servo_rate=50.0, velocity_gain=0.01))},
            action="position",
            randomize={"loop.velocity_gain": "uniform(0.001, 0.5)"},
        )


def test_a_position_loop_faster_than_a_step_causes_a_warning():
    """The target is reached late: the pole is 1 - 1.5*exp(-1.5) instead of exp(-1.5)."""
    with pytest.warns(UserWarning, match=r"position_gain = 30: .* Shorten the step to 0\.0333 s"):
        pendulum(
            dataclasses.replace(
                servo(velocity_gain=48.0), loop=ServoLoop(position_gain=30.0, velocity_gain=48.0)
            )
        )
