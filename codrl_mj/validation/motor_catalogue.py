"""Off-the-shelf motors, in every task, against Gymnasium's equations with a rotor, a gear and friction on the joint.

Gymnasium's environments have no place for what a drive adds to its joint. Their equations, linear
in the force, have: with a_0 the joint's acceleration under no force and w its slope over the force,
an inertia A, a damping D and a friction f make it a = a_0 + w (F + f - D v - A a), so that the
unmodified environment under the force in brackets moves as the joint with the rotor does. MuJoCo's
Euler takes the damping at the new speed: A + h D in the place of A. Friction is MuJoCo's as its
documentation has it (Computation, "Friction loss"; Modeling, "Solver parameters"), which for one
joint is a closed form.

The motor of the oracle is written here anew: the winding by scipy's matrix exponential, sample by
sample under a PI loop that cancels its pole. Nothing of `codrl_mj.actuators` is in it but the
numbers of a `Drive`.
"""

import math
from collections.abc import Iterator

import numpy as np
from gymnasium.envs.classic_control.acrobot import rk4
from scipy.linalg import expm

from codrl_mj.actuators import Drive, resolve
from codrl_mj.catalogue import motor_names
from codrl_mj.physics import MujocoPhysics, SimulationConfig, SimulationDivergedError
from codrl_mj.tasks import Task
from codrl_mj.validation.compare import differences, gymnasium_equations
from codrl_mj.validation.rotors import HELD, drive, motors_on
from codrl_mj.validation.table import Case, Check, check

FITTED = {
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
"""Task -> a motor of the catalogue that can do it, its gear or wheel, and its drive's sample rate
[Hz]. What a gear loses depends on what else moves the load, which the drive takes from the step
before.
"""
COLD = {
    "thermal_resistance_winding": 0.0,
    "thermal_resistance_housing": 0.0,
    "max_temperature": math.inf,
}
"""A motor whose resistance stays."""


def fitted(task: str) -> Drive:
    """The drive of `FITTED` for a task."""
    name, motor, rate = FITTED[task]
    given = {"name": name, "motor": {**COLD, **motor}, "controller": {"sample_rate": rate}}
    found: Drive = resolve(given, None, task)
    return found


class Bench:
    """A drive's winding and loop, sample by sample."""

    def __init__(self, one: Drive, timestep: float) -> None:
        """At rest, with designed gains, back-calculation and a stiff supply; timestep: mechanical [s]."""
        motor, sample = one.motor, 1.0 / one.controller.sample_rate
        self._motor, self._timestep = motor, timestep
        self._voltage, self._most = one.voltage_limit, one.controller.max_current
        self._samples = round(timestep / sample)
        lag = [-motor.resistance / motor.inductance, 0.0, 1.0 / motor.inductance]
        exact = expm(
            np.array([lag, [1.0, 0.0, 0.0], [0.0] * 3]) * sample
        )  # of current, charge and voltage
        self._winding = exact[:2].tolist()
        share = 1.0 - math.exp(
            -0.349
        )  # the default bandwidth is 0.349 of the sample rate, in rad/s
        self.ki = motor.resistance * share  # [V/A], per sample
        self.kp = self.ki / math.expm1(motor.resistance * sample / motor.inductance)  # [V/A]
        self._current = self._integral = 0.0

    def torque(self, desired: float, speed: float) -> float:
        """Mean torque [N*m] of the next step at the rotor, behind the gear, of a desired one at a speed [rad/s]."""
        motor, charge, current, integral = self._motor, 0.0, self._current, self._integral
        (decay, _, effect), (kept, _, passed) = self._winding
        back_emf, kp, ki, most = motor.back_emf_constant * speed, self.kp, self.ki, self._voltage
        reference = min(max(desired / motor.torque_constant, -self._most), self._most)
        for _ in range(self._samples):
            error = reference - current
            asked = kp * error + integral + ki * error + back_emf
            applied = min(max(asked, -most), most)
            integral += ki * error + (applied - asked) * ki / (kp + ki)
            charge += kept * current + passed * (applied - back_emf)
            current = decay * current + effect * (applied - back_emf)
        self._current, self._integral = current, integral
        torque = motor.torque_constant * charge / self._timestep
        share = (
            1.0 - motor.gear_efficiency
            if torque * speed > 0.0
            else 1.0 / motor.gear_efficiency - 1.0
        )
        stops = (
            motor.rotor_inertia * abs(speed) / self._timestep if motor.rotor_inertia else math.inf
        )
        return torque - math.copysign(min(share * abs(torque), stops), speed) * (speed != 0.0)


class Mechanics:
    """Gymnasium's environment of a task, with what a drive adds to its joint."""

    def __init__(self, task: Task, one: Drive, timestep: float, integrator: str) -> None:
        """Of a task with a twin and one motor, at an integration step [s]."""
        motor, arm = one.motor, one.motor.arm_radius / one.motor.gear_ratio
        self._armature, self._damping = (
            motor.rotor_inertia / arm**2,
            motor.viscous_friction / arm**2,
        )
        self._friction = motor.coulomb_friction / arm
        self._task, self._timestep, self._integrator = task, timestep, integrator
        assert task.reference_env is not None
        self._twin, self._equations, self._at = (
            task.reference_env(),
            gymnasium_equations(task),
            task.speed_indices[0],
        )
        _, slope = self._linear(np.zeros(len(task.state_names)))
        self._softness = (
            (1.0 - 0.9) / 0.9 * slope / (1.0 + self._armature * slope)
        )  # solimp's d at 0 is 0.9
        self._stiffness = 2.0 / (
            0.95 * max(0.02, 2.0 * timestep)
        )  # solref's time constant; solimp's largest d

    def _linear(self, state: np.ndarray) -> tuple[float, float]:
        """The joint's acceleration under no force, and its slope over the force."""
        free = self._equations(state, 0.0)[self._at]
        return float(free), float(self._equations(state, 1.0)[self._at] - free)

    def _force(self, state: np.ndarray, force: float) -> float:
        """The force under which Gymnasium's environment moves as the joint with the rotor does under `force`."""
        (free, slope), speed = self._linear(state), float(state[self._at])
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
        """The state one integration step later, the force [N or N*m] held; in Gymnasium's bounds."""
        if self._integrator != "rk4":
            return self._twin(state, self._force(state, force), self._timestep, self._integrator)
        after = rk4(
            lambda now: self._equations(now, self._force(now, force)), state, [0.0, self._timestep]
        )
        assert self._task.constrain is not None
        return np.array(self._task.constrain(after, self._timestep))


_TWIN = "Gymnasium {task.gymnasium_id} with a rotor on its joint, the winding by scipy.linalg.expm"


@check("trajectories", Check("run, {integrator}, {motor}", _TWIN, 1e-9))
def fitted_run(task: Task, integrator: str, quick: bool) -> Iterator[Case]:
    """A run of a task with its drive of `FITTED`, which has that motor, in the engine, under bang-bang commands."""
    one, generator = fitted(task.name), np.random.default_rng(0)
    inner, arm, speed = task.motor_inner_steps, one.arm_radius, task.speed_indices[0]
    longest = round((5e4 if quick else 5e5) / (task.step_duration * one.controller.sample_rate))
    steps = min(
        longest,
        task.max_episode_steps or longest,
        (task.reference_states and task.reference_states.horizon) or longest,
    )
    timestep, state = task.step_duration / inner, task.draw_initial_state(generator, None)
    physics = MujocoPhysics(SimulationConfig(task, [one], inner, integrator))
    physics.reset(state)
    bench, mechanics = Bench(one, timestep), Mechanics(task, one, timestep, integrator)
    gaps: list[np.ndarray] = []
    names, error = task.state_names, ""
    for force in task.max_force * generator.choice([-1.0, 1.0], steps):
        try:
            physics.step(force)
        except SimulationDivergedError as diverged:
            error = str(diverged)
            break
        for _ in range(inner):
            state = mechanics.step(state, bench.torque(force * arm, state[speed] / arm) / arm)
        gaps.append(differences(task, physics.state, state))
    yield Case(gaps, lambda at: f"{names[at % len(names)]} at step {at // len(names) + 1}", steps)
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
    """Every motor of the catalogue at held speeds in the engine: against its winding, and in closed form and stepped.

    Torques are measured against the stall torque: the closed form is good to 1e-13 of it, and so is
    a sum of samples.
    """
    timestep, steps, generator = 0.002, 20 if quick else 200, np.random.default_rng(0)
    given = {"motor": COLD | {"load_inertia": math.inf}, "controller": {"sample_rate": 20e3}}
    jumping = {name: resolve({"name": name, **given}, None, name) for name in motor_names()}
    benches = [Bench(one, timestep) for one in jumping.values()]
    stepping = [
        one.replaced({"controller.kp": bench.kp, "controller.ki": bench.ki * 20e3})
        for one, bench in zip(jumping.values(), benches, strict=True)
    ]
    stalls = np.array(
        [one.motor.torque_constant * one.voltage_limit / one.motor.resistance for one in stepping]
    )
    fastest = np.array([one.voltage_limit / one.motor.back_emf_constant for one in stepping])
    arms = np.array([one.arm_radius for one in stepping])
    torques = generator.uniform(-1.5, 1.5, (steps, len(stalls))) * stalls
    speeds = generator.uniform(-1.0, 1.0, torques.shape) * fastest
    ours, stepped = (
        drive(motors_on(HELD, list(drives), timestep), torques, speeds * arms).torque * arms
        for drives in (jumping.values(), stepping)
    )
    exact = np.array(
        [
            [bench.torque(*inputs) for bench, *inputs in zip(benches, *rows, strict=True)]
            for rows in zip(torques.tolist(), speeds.tolist(), strict=True)
        ]
    )
    names, gaps = list(jumping), (np.abs(ours - found) / stalls for found in (exact, stepped))
    yield tuple(Case(found, lambda at: names[at % len(names)]) for found in gaps)
