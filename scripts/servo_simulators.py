"""Logs of known position servos from simulations that are not ours: BAM's equations and MuJoCo."""

import dataclasses
import math
from typing import NamedTuple

import mujoco
import numpy as np

from codrl_mj.identify import Log

GRAVITY = 9.81
COUNTS = 4096
KINDS = ("bam", "bam_m3", "mujoco_position", "mujoco_dcmotor", "pwm")
"""Simulations: BAM's equations with friction M1 and M3, MuJoCo's actuators, a servo with PWM."""
STEP = 1e-4
"""Time step of the simulations [s]."""


@dataclasses.dataclass(frozen=True)
class Servo:
    """A position servo with a pendulum at its output."""

    torque_constant: float  # [N*m/A]
    resistance: float  # [ohm]
    duty_gain: float  # duty per angle error [1/rad]
    volts: float  # [V]
    armature: float  # [kg*m^2]
    coulomb: float  # [N*m]
    viscous: float  # [N*m*s/rad]
    load_friction: float  # share of the load
    mass: float  # [kg]
    length: float  # [m]
    zero: float  # position at which the pendulum hangs [rad]
    delay: float  # [s]

    @property
    def load_inertia(self) -> float:
        """Inertia of the pendulum [kg*m^2]."""
        return self.mass * self.length**2

    @property
    def mgl(self) -> float:
        """Largest torque of gravity [N*m]."""
        return self.mass * GRAVITY * self.length

    @property
    def stall_torque(self) -> float:
        """Torque at full duty and standstill [N*m]."""
        return self.torque_constant / self.resistance * self.volts

    @property
    def truth(self) -> dict[str, float]:
        """True values of the parameters that a fit gives."""
        return {
            "position_gain": self.stall_torque * self.duty_gain,
            "stall_torque": self.stall_torque,
            "damping": self.torque_constant**2 / self.resistance + self.viscous,
            "armature": self.armature,
            "coulomb_friction": self.coulomb,
            "command_delay": self.delay,
            "zero": self.zero,
            "duty_gain": self.duty_gain,
        }

    @property
    def known(self) -> dict[str, float]:
        """Parameters of the load, which a user has weighed and measured."""
        return {"mgl": self.mgl, "load_inertia": self.load_inertia}


def draw(seed: int, kind: str = "bam") -> Servo:
    """Return a random servo: a motor of 0.3 to 4 N*m with a pendulum of a fifth to a half of it."""
    random = np.random.default_rng((seed, KINDS.index(kind)))
    stall, volts = (
        math.exp(random.uniform(math.log(0.5), math.log(4.0))),
        random.choice([7.4, 12.0]),
    )
    no_load_speed = random.uniform(4.0, 12.0)
    constant = volts / no_load_speed
    mgl, length = stall * random.uniform(0.2, 0.45), random.uniform(0.08, 0.2)
    mass = mgl / GRAVITY / length
    return Servo(
        torque_constant=constant,
        resistance=constant * volts / stall,
        duty_gain=math.exp(random.uniform(math.log(1.0), math.log(6.0))),
        volts=volts,
        armature=mass * length**2 * random.uniform(0.2, 1.0),
        coulomb=stall * random.uniform(0.015, 0.06),
        viscous=stall / no_load_speed * random.uniform(0.02, 0.2),
        load_friction=random.uniform(0.05, 0.2) if kind == "bam_m3" else 0.0,
        mass=mass,
        length=length,
        zero=random.uniform(-0.04, 0.04),
        delay=random.uniform(0.0, 0.03),
    )


def commands(times: np.ndarray, seed: int = 0) -> np.ndarray:
    """Return commands [rad]: a sweep, steps and sines, for a third of the time each."""
    random = np.random.default_rng((seed, 99))
    third = times[-1] / 3.0
    local = times % third
    sweep = random.uniform(0.6, 1.0) * np.sin((local * random.uniform(0.9, 1.3)) ** 2)
    levels = random.uniform(-1.2, 1.2, 64)
    steps = levels[(local / 0.7).astype(int)]
    sines = 1.3 * np.sin(1.1 * local) + 0.4 * np.sin(5.0 * local) * np.sin(2.0 * local)
    return np.select([times < third, times < 2.0 * third], [sweep, steps], sines)


class _Commands(NamedTuple):
    """Commands of a log of n rows, and of the m steps of its simulation."""

    times: np.ndarray  # [s], shape (n,)
    targets: np.ndarray  # [rad], shape (n,)
    held: np.ndarray  # late by the delay, and held until the next row [rad], shape (m,)


class Motion(NamedTuple):
    """Motion of a simulated servo, at its m time steps."""

    positions: np.ndarray  # [rad], shape (m,)
    duties: np.ndarray  # from -1 to 1, shape (m,)


def _held(servo: Servo, seed: int, duration: float, rate: float) -> _Commands:
    """Return the commands of a log, and those that reach the servo at each step."""
    times = np.arange(round(duration * rate)) / rate
    targets = commands(times, seed)
    grid = STEP * np.arange(round(duration / STEP))
    rows = np.floor((grid - servo.delay) * rate + 1e-9).astype(int)
    return _Commands(times, targets, targets[np.clip(rows, 0, None)])


def simulate_bam(servo: Servo, targets: np.ndarray) -> Motion:
    """Return the motion by BAM's equations with its friction M1 or M3."""
    position = speed = 0.0
    inertia = servo.load_inertia + servo.armature
    positions, duties = np.empty(len(targets)), np.empty(len(targets))
    slope = servo.torque_constant**2 / servo.resistance
    for row, target in enumerate(targets):
        positions[row] = position
        duty = min(max(servo.duty_gain * (target - position), -1.0), 1.0)
        duties[row] = duty
        gravity = -servo.mgl * math.sin(position - servo.zero)
        motor = servo.stall_torque * duty - slope * speed
        net = motor + gravity
        friction = servo.coulomb + servo.load_friction * abs(gravity - motor)
        stop = inertia / STEP * speed + net
        largest = friction + servo.viscous * abs(speed)
        net -= math.copysign(min(abs(stop), largest), stop)
        acceleration = net / inertia
        speed += acceleration * STEP
        position += speed * STEP + 0.5 * acceleration * STEP**2
    return Motion(positions, duties)


def simulate_pwm(servo: Servo, targets: np.ndarray, period: float = 2e-3, bits: int = 10) -> Motion:
    """Return the motion of a servo whose firmware runs every 2 ms with a PWM of 10 bits.

    The shaft is integrated at half the step by explicit equations that hold it while its
    friction exceeds all other torques.
    """
    position = speed = duty = 0.0
    inertia = servo.load_inertia + servo.armature
    slope = servo.torque_constant**2 / servo.resistance + servo.viscous
    positions, duties = np.empty(len(targets)), np.empty(len(targets))
    every, substep, levels = round(period / STEP), STEP / 2.0, 2.0**bits
    for row, target in enumerate(targets):
        positions[row] = position
        if row % every == 0:
            read = round(position / (2.0 * math.pi) * COUNTS) / COUNTS * 2.0 * math.pi
            duty = min(max(servo.duty_gain * (target - read), -1.0), 1.0)
            duty = round(duty * levels) / levels
        duties[row] = duty
        for _ in range(2):
            torque = servo.stall_torque * duty - slope * speed
            torque -= servo.mgl * math.sin(position - servo.zero)
            if speed == 0.0:
                torque -= math.copysign(min(servo.coulomb, abs(torque)), torque)
                speed = torque / inertia * substep
            else:
                before = speed
                speed += (torque - math.copysign(servo.coulomb, speed)) / inertia * substep
                speed = 0.0 if speed * before < 0.0 else speed
            position += speed * substep
    return Motion(positions, duties)


def simulate_mujoco(servo: Servo, targets: np.ndarray, kind: str) -> Motion:
    """Return the motion of MuJoCo's `<position>` or `<dcmotor>` at a hinge."""
    gain = servo.stall_torque * servo.duty_gain
    damping = servo.torque_constant**2 / servo.resistance
    actuator = (
        f'<position joint="hinge" kp="{gain}" kv="{damping}"'
        f' forcerange="{-servo.stall_torque} {servo.stall_torque}"/>'
        if kind == "mujoco_position"
        else f'<dcmotor joint="hinge" motorconst="{servo.torque_constant}"'
        f' resistance="{servo.resistance}"/>'
    )
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><option timestep="{STEP}" integrator="implicitfast" gravity="0 0 -{GRAVITY}"/>
        <worldbody><body><joint name="hinge" axis="0 1 0" damping="{servo.viscous}"
        frictionloss="{servo.coulomb}" armature="{servo.armature}" solreffriction="0.001 1"/>
        <inertial mass="{servo.mass}" pos="{servo.length * math.sin(servo.zero)} 0
        {-servo.length * math.cos(servo.zero)}" diaginertia="1e-9 1e-9 1e-9"/></body></worldbody>
        <actuator>{actuator}</actuator></mujoco>"""
    )
    data = mujoco.MjData(model)
    positions, duties = np.empty(len(targets)), np.empty(len(targets))
    for row, target in enumerate(targets):
        positions[row] = data.qpos[0]
        duty = min(max(servo.duty_gain * (target - positions[row]), -1.0), 1.0)
        duties[row] = duty
        data.ctrl[0] = target if kind == "mujoco_position" else duty * servo.volts
        mujoco.mj_step(model, data)
    return Motion(positions, duties)


def servo_log(
    servo: Servo,
    kind: str = "bam",
    seed: int = 0,
    duration: float = 12.0,
    rate: float = 200.0,
    with_duty: bool = False,
) -> Log:
    """Return a log of a servo: commands, and positions of an encoder with 4096 counts a turn."""
    times, targets, held = _held(servo, seed, duration, rate)
    if kind.startswith("mujoco"):
        positions, duties = simulate_mujoco(servo, held, kind)
    else:
        positions, duties = (simulate_pwm if kind == "pwm" else simulate_bam)(servo, held)
    stride = round(1.0 / rate / STEP)
    count = 2.0 * math.pi / COUNTS
    signals = {
        "command": targets,
        "position": np.round(positions[::stride][: len(times)] / count) * count,
    }
    if with_duty:
        signals |= {"duty": duties[::stride], "bus": np.full(len(times), servo.volts)}
    return Log(f"{kind}{seed}", times, signals, {"position": count})
