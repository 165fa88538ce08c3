"""Comparison of off-the-shelf motors in every task with Gymnasium's equations plus a drive.

Gymnasium's environments have no rotor inertia, gear or friction on the joint. Because their
equations are linear in the force, these can be added from outside: with a_0 the joint's
acceleration under no force and w its slope over the force, an inertia A, a damping D and a friction
f make it a = a_0 + w (F + f - D v - A a), so that the unmodified environment under the force in
parentheses moves like the joint with the rotor. MuJoCo's Euler takes the damping at the new speed:
A + h D replaces A. Friction follows MuJoCo's documentation (Computation, "Friction loss"; Modeling,
"Solver parameters"), which for one joint is a closed form.

The oracle's motor is a second implementation: the winding by scipy's matrix exponential, sample by
sample under a PI loop that cancels its pole. It uses nothing of `codrl_mj.actuators` but the
parameters of a `Drive`.
"""

import math
from collections.abc import Iterator
from typing import cast

import numpy as np
from scipy.linalg import expm

from codrl_mj.actuators import Drive, resolve
from codrl_mj.catalogue import motor_names
from codrl_mj.physics import MujocoPhysics, SimulationConfig, SimulationDivergedError
from codrl_mj.tasks import Task
from codrl_mj.validation.compare import differences, gymnasium_equations, rk4
from codrl_mj.validation.rotors import LOCKED_ROTOR, build_rotors, simulate
from codrl_mj.validation.table import Case, Check, check

TASK_MOTORS = {
    "pendulum": ("maxon-ec45-flat-50w", {"gear_ratio": 30.0}, 20e3),
    "cartpole": ("maxon-dcx22l", {"gear_ratio": 5.0, "arm_radius": 0.02}, 20e3),
    "acrobot": ("cubemars-ak80-6", {"gear_efficiency": 1.0}, 20e3),
    "mountain_car": ("quanser-srv02", {"gear_efficiency": 1.0, "arm_radius": 0.35}, 10e3),
    "mountain_car_continuous": (
        "lego-ev3-large",
        {"gear_efficiency": 1.0, "arm_radius": 0.2},
        10e3,
    ),
}
"""Task -> a suitable motor of the catalogue, changes of its gear or wheel, sample rate [Hz].

A gear's efficiency is set to 1 in some tasks: its loss depends on the other forces on the load,
which the drive takes from the step before.
"""
NO_HEATING = {
    "thermal_resistance_winding": 0.0,
    "thermal_resistance_housing": 0.0,
    "max_temperature": math.inf,
}
"""Motor settings without heating, so that the resistance is constant."""


def task_drive(task: str) -> Drive:
    """Return the drive of `TASK_MOTORS` for a task."""
    name, motor, rate = TASK_MOTORS[task]
    fields = {"name": name, "motor": {**NO_HEATING, **motor}, "controller": {"sample_rate": rate}}
    return cast(Drive, resolve(fields, None, task))


class DriveOracle:
    """A second implementation of a drive's winding and current loop, sample by sample.

    It has designed gains, back-calculation and a stiff supply.
    """

    def __init__(self, actuator: Drive, timestep: float) -> None:
        """Start at rest, with the timestep of the mechanics [s]."""
        motor, sample = actuator.motor, 1.0 / actuator.controller.sample_rate
        self._motor, self._timestep = motor, timestep
        self._voltage, self._max_current = actuator.voltage_limit, actuator.controller.max_current
        self._samples = round(timestep / sample)
        lag = [-motor.resistance / motor.inductance, 0.0, 1.0 / motor.inductance]
        # The state is current, charge and voltage; the charge gives the sample's mean current.
        exact = expm(np.array([lag, [1.0, 0.0, 0.0], [0.0] * 3]) * sample)
        self._winding = exact[:2].tolist()
        # The default bandwidth is 0.349 of the sample rate, in rad/s.
        share = 1.0 - math.exp(-0.349)
        # Gains in V/A, ki for one sample.
        self.ki = motor.resistance * share
        self.kp = self.ki / math.expm1(motor.resistance * sample / motor.inductance)
        self._current = self._integral = 0.0

    def torque(self, desired: float, speed: float) -> float:
        """Return the rotor's mean torque in the next step, after gear losses.

        Args:
            desired: desired torque at the rotor [N*m].
            speed: speed of the rotor [rad/s].
        """
        motor, charge, current, integral = self._motor, 0.0, self._current, self._integral
        (decay, _, effect), (charge_per_current, _, charge_per_volt) = self._winding
        back_emf = motor.back_emf_constant * speed
        kp = self.kp
        ki = self.ki
        max_voltage = self._voltage
        reference = min(max(desired / motor.torque_constant, -self._max_current), self._max_current)
        for _ in range(self._samples):
            error = reference - current
            voltage = kp * error + integral + ki * error + back_emf
            applied = min(max(voltage, -max_voltage), max_voltage)
            integral += ki * error + (applied - voltage) * ki / (kp + ki)
            charge += charge_per_current * current + charge_per_volt * (applied - back_emf)
            current = decay * current + effect * (applied - back_emf)
        self._current, self._integral = current, integral
        torque = motor.torque_constant * charge / self._timestep
        share = (
            1.0 - motor.gear_efficiency
            if torque * speed > 0.0
            else 1.0 / motor.gear_efficiency - 1.0
        )
        # A gear loss can stop the rotor within a step, but not reverse it.
        stopping = (
            motor.rotor_inertia * abs(speed) / self._timestep if motor.rotor_inertia else math.inf
        )
        return torque - math.copysign(min(share * abs(torque), stopping), speed) * (speed != 0.0)


class JointOracle:
    """Gymnasium's environment of a task, with the inertia, damping and friction of a drive."""

    def __init__(self, task: Task, actuator: Drive, timestep: float, integrator: str) -> None:
        """Prepare a task with a reference environment and one motor; `timestep` is in seconds."""
        motor, arm = actuator.motor, actuator.motor.arm_radius / actuator.motor.gear_ratio
        self._armature = motor.rotor_inertia / arm**2
        self._damping = motor.viscous_friction / arm**2
        self._friction = motor.coulomb_friction / arm
        self._task, self._timestep, self._integrator = task, timestep, integrator
        assert task.reference_env is not None
        self._reference_env = task.make_reference_env()
        self._equations = gymnasium_equations(task)
        self._speed_index = task.speed_indices[0]
        _, slope = self._linear(np.zeros(len(task.state_names)))
        # MuJoCo's defaults: impedance d = 0.9 at zero violation (solimp), a time constant of 0.02 s
        # but at least two steps (solref), and a largest impedance of 0.95.
        self._softness = (1.0 - 0.9) / 0.9 * slope / (1.0 + self._armature * slope)
        self._stiffness = 2.0 / (0.95 * max(0.02, 2.0 * timestep))

    def _linear(self, state: np.ndarray) -> tuple[float, float]:
        """Return the joint's acceleration under no force, and its slope over the force."""
        free = self._equations(state, 0.0)[self._speed_index]
        return float(free), float(self._equations(state, 1.0)[self._speed_index] - free)

    def _force(self, state: np.ndarray, force: float) -> float:
        """Return the force that moves the environment as `force` moves the joint with the rotor."""
        (free, slope), speed = self._linear(state), float(state[self._speed_index])
        force -= self._damping * speed
        smooth = (free + slope * force) / (1.0 + self._armature * slope)
        if self._friction:
            holding = -self._stiffness * speed - smooth
            holding /= slope / (1.0 + self._armature * slope) + self._softness
            force += min(max(holding, -self._friction), self._friction)
        implicit = self._integrator == "semi-implicit"
        inertia = self._armature + (self._timestep * self._damping if implicit else 0.0)
        return force - inertia * (free + slope * force) / (1.0 + inertia * slope)

    def step(self, state: np.ndarray, force: float) -> np.ndarray:
        """Return the state after a step under a force [N or N*m], within the bounds."""
        if self._integrator != "rk4":
            return self._reference_env(
                state, self._force(state, force), self._timestep, self._integrator
            )
        after = rk4(
            lambda stage: self._equations(stage, self._force(stage, force)),
            state,
            [0.0, self._timestep],
        )
        assert self._task.constrain is not None
        return np.array(self._task.constrain(after, self._timestep))


_ORACLE = (
    "Gymnasium {task.gymnasium_id} with a rotor on its joint, the winding by scipy.linalg.expm"
)


@check("trajectories", Check("run, {integrator}, {motor}", _ORACLE, 1e-9))
def task_motor_run(task: Task, integrator: str, quick: bool) -> Iterator[Case]:
    """Compare a task's run with its drive of `TASK_MOTORS`, under random bang-bang commands."""
    actuator, generator = task_drive(task.name), np.random.default_rng(0)
    inner_steps = task.motor_inner_steps
    arm = actuator.arm_radius
    speed_index = task.speed_indices[0]
    # The oracle computes every sample in Python, so their number is limited.
    max_steps = round(
        (5e4 if quick else 5e5) / (task.step_duration * actuator.controller.sample_rate)
    )
    steps = min(
        max_steps,
        task.max_episode_steps or max_steps,
        (task.reference_states and task.reference_states.horizon) or max_steps,
    )
    timestep, state = task.step_duration / inner_steps, task.draw_initial_state(generator, None)
    physics = MujocoPhysics(SimulationConfig(task, [actuator], inner_steps, integrator))
    physics.reset(state)
    winding = DriveOracle(actuator, timestep)
    mechanics = JointOracle(task, actuator, timestep, integrator)
    gaps: list[np.ndarray] = []
    names, error = task.state_names, ""
    for force in task.max_force * generator.choice([-1.0, 1.0], steps):
        try:
            physics.step(force)
        except SimulationDivergedError as diverged:
            error = str(diverged)
            break
        for _ in range(inner_steps):
            state = mechanics.step(
                state, winding.torque(force * arm, state[speed_index] / arm) / arm
            )
        gaps.append(differences(task, physics.state, state))
    yield Case(
        gaps, lambda index: f"{names[index % len(names)]} at step {index // len(names) + 1}", steps
    )
    if error:
        yield Case(math.inf, error, 0)


@check(
    "motor",
    Check(
        "drives, exact winding", "scipy.linalg.expm, sample by sample", 1e-10, "of the stall torque"
    ),
    Check(
        "drives, closed form",
        "the same loops with their gains given, which are stepped in the engine",
        1e-10,
        "of the stall torque",
    ),
)
def drive_checks(quick: bool) -> Iterator[tuple[Case, ...]]:
    """Compare all motors of the catalogue, in the engine at held speeds, with two references.

    The references are the oracle's winding, and the same loops computed sample by sample in the
    engine instead of in closed form. Errors are relative to the stall torque: the closed form is
    accurate to 1e-13 of it, and so is a sum of samples.
    """
    timestep, steps, generator = 0.002, 20 if quick else 200, np.random.default_rng(0)
    fields = {"motor": NO_HEATING | {"load_inertia": math.inf}, "controller": {"sample_rate": 20e3}}
    # Designed gains allow the closed form of a whole step. Explicit gains, even of the same values,
    # make the engine compute every sample.
    closed_form = {
        name: cast(Drive, resolve({"name": name, **fields}, None, name)) for name in motor_names()
    }
    oracles = [DriveOracle(actuator, timestep) for actuator in closed_form.values()]
    stepping = [
        actuator.replaced({"controller.kp": oracle.kp, "controller.ki": oracle.ki * 20e3})
        for actuator, oracle in zip(closed_form.values(), oracles, strict=True)
    ]
    stalls = np.array(
        [
            actuator.motor.torque_constant * actuator.voltage_limit / actuator.motor.resistance
            for actuator in stepping
        ]
    )
    no_load_speeds = np.array(
        [actuator.voltage_limit / actuator.motor.back_emf_constant for actuator in stepping]
    )
    arms = np.array([actuator.arm_radius for actuator in stepping])
    torques = generator.uniform(-1.5, 1.5, (steps, len(stalls))) * stalls
    speeds = generator.uniform(-1.0, 1.0, torques.shape) * no_load_speeds
    ours, stepped = (
        simulate(build_rotors(LOCKED_ROTOR, list(drives), timestep), torques, speeds * arms).torque
        * arms
        for drives in (closed_form.values(), stepping)
    )
    exact = np.array(
        [
            [oracle.torque(*inputs) for oracle, *inputs in zip(oracles, *rows, strict=True)]
            for rows in zip(torques.tolist(), speeds.tolist(), strict=True)
        ]
    )
    names = list(closed_form)
    gaps = (np.abs(ours - reference) / stalls for reference in (exact, stepped))
    yield tuple(Case(gap, lambda index: names[index % len(names)]) for gap in gaps)
