"""Tests that every convergence check fails if the physics are wrong."""

import dataclasses

import gymnasium
import numpy as np
import pytest

from codrl_mj.actuators import IDEAL
from codrl_mj.physics import AnalyticPhysics, MujocoPhysics, SimulationConfig
from codrl_mj.tasks import TASKS
from codrl_mj.validation import convergence
from codrl_mj.validation.compare import gymnasium_equations
from codrl_mj.validation.convergence import free_run, solve
from tests.reference import cartpole_accelerations
from tests.validation.mutations import (
    euler,
    failed,
    late_force,
    once,
    scaled,
    scaled_motor,
    wrong_model,
)

pytestmark = pytest.mark.usefixtures("bare_engine")

RATE = "rate in the loop's bandwidth"


def ideal(task):
    return {f"order, {integrator}, ideal actuator" for integrator in TASKS[task].integrators}


def with_motor(task):
    return {f"order, {integrator}, motor in the loop" for integrator in TASKS[task].integrators}


def failures(monkeypatch, task):
    """Return the names of the checks that fail because of a fault in MuJoCo."""
    # Solutions and analytic runs do not depend on the fault, so they are computed only once.
    for name in ("solve", "_simulated_states"):
        monkeypatch.setattr(convergence, name, once(getattr(convergence, name), MujocoPhysics))
    return failed(convergence.checks(task, quick=True))


MOTOR = {"inductance": 1.05, "resistance": 1.05, "torque_constant": 1.05, "back_emf_constant": -1.0}
FAULTS = [
    # Each row has the task, the model's fault, the groups of checks that must fail (ideal, motor,
    # rate), and the groups that may fail.
    *((task, scaled("body_mass", 1.01), "ideal motor rate", "") for task in TASKS),
    *(
        (task, scaled("actuator_gear", 1.01), "motor rate", "ideal")
        for task in ("pendulum", "acrobot")
    ),
    *(("pendulum", scaled_motor(*change), "motor", "rate") for change in MOTOR.items()),
    ("acrobot", euler, "ideal", "motor rate"),
    # This simulation diverges.
    ("pendulum", scaled("actuator_gear", 1e9), "ideal motor rate", ""),
]


@pytest.mark.parametrize(("task", "fault", "must_fail", "may_fail"), FAULTS)
def test_wrong_model_fails_the_affected_checks(monkeypatch, task, fault, must_fail, may_fail):
    wrong_model(monkeypatch, fault)
    names = {"ideal": ideal(task), "motor": with_motor(task), "rate": {RATE}}
    required, allowed = (
        set().union(*(names[group] for group in groups.split())) for groups in (must_fail, may_fail)
    )
    assert required <= failures(monkeypatch, task) <= required | allowed


@pytest.mark.parametrize("task", ["pendulum", "mountain_car"])
def test_force_one_step_late_fails_every_check(monkeypatch, task):
    late_force(monkeypatch)
    assert failures(monkeypatch, task) == ideal(task) | with_motor(task) | {RATE}


def test_wrong_force_in_the_analytic_physics_fails_every_check(monkeypatch):
    step = AnalyticPhysics.step
    monkeypatch.setattr(AnalyticPhysics, "step", lambda self, force: step(self, 1.01 * force))
    assert ideal("cartpole") | with_motor("cartpole") <= failed(
        convergence.checks("cartpole", quick=True)
    )


# -- the oracle ------------------------------------------------------------------------------------


def test_oracle_is_the_installed_gymnasium(monkeypatch):
    """Check that a change of Gymnasium's equations makes MuJoCo differ from the oracle."""
    make = gymnasium.envs.classic_control.CartPoleEnv.__init__

    def lighter(self, *arguments, **options):
        make(self, *arguments, **options)
        self.gravity *= 0.99

    monkeypatch.setattr(gymnasium.envs.classic_control.CartPoleEnv, "__init__", lighter)
    checks = [
        check for check in convergence.checks("cartpole", quick=True) if "ideal" in check.name
    ]
    assert checks
    for check in checks:
        assert not check.passed
        assert check.where.startswith("MuJoCo")


def test_equations_equal_the_textbook():
    generator = np.random.default_rng(0)
    pendulum, cartpole = (gymnasium_equations(TASKS[name]) for name in ("pendulum", "cartpole"))
    car = gymnasium_equations(TASKS["mountain_car_continuous"])
    for _ in range(20):
        angle, speed, force = generator.uniform(-2, 2, 3)
        expected = [speed, 15.0 * np.sin(angle) + 3.0 * force]
        np.testing.assert_allclose(
            pendulum(np.array([angle, speed]), force), expected, rtol=0, atol=1e-11
        )
        accelerations = cartpole_accelerations(angle, speed, force)
        expected = [0.1, accelerations[0], speed, accelerations[1]]
        np.testing.assert_allclose(
            cartpole(np.array([0.0, 0.1, angle, speed]), force), expected, rtol=0, atol=1e-11
        )
        x, v = generator.uniform(-0.9, 0.3), generator.uniform(-0.02, 0.02)
        expected = [v, 0.0015 * force / 2 - 0.0025 * np.cos(3 * x)]
        np.testing.assert_allclose(car(np.array([x, v]), force / 2), expected, rtol=0, atol=1e-14)


def test_acrobot_equations_are_the_limit_of_its_steps():
    task = TASKS["acrobot"]
    equations, state = gymnasium_equations(task), np.array([0.3, -0.7, 0.9, -1.1])
    physics = AnalyticPhysics(
        SimulationConfig(dataclasses.replace(task, step_duration=1e-4), [IDEAL], 1, "rk4")
    )
    physics.reset(state)
    physics.step(1.0)
    np.testing.assert_allclose(
        (physics.state - state) / 1e-4, equations(state, 1.0), rtol=0, atol=2e-3
    )


@pytest.mark.parametrize("motor", [False, True], ids=["ideal", "motor"])
@pytest.mark.parametrize("task", [task for task in TASKS if TASKS[task].constrain is not None])
def test_runs_stay_away_from_every_bound(task, motor):
    """Check the states of the solution, and of a fine run at every integration step."""
    definition = TASKS[task]
    start, forces, _ = free_run(definition)
    actuators = convergence.continuous_actuators(definition) if motor else [IDEAL]
    states = [*solve(definition, gymnasium_equations(definition), start, forces, actuators)]
    unbounded = dataclasses.replace(
        definition, step_duration=definition.step_duration / 128, constrain=None
    )
    physics = MujocoPhysics(SimulationConfig(unbounded, actuators, 1, definition.integrators[0]))
    physics.reset(start)
    for force in forces:
        for _ in range(128):
            physics.step(force)
            states.append(physics.state)
    entries = np.array(states).T
    np.testing.assert_array_equal(
        definition.constrain(entries, definition.step_duration / 16), entries
    )
