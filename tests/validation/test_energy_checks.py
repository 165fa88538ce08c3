"""Tests that every energy balance fails if the physics are wrong."""

import numpy as np
import pytest

from codrl_mj.engine.hill import GRAVITY
from codrl_mj.physics import AnalyticPhysics, MujocoPhysics, SimulationDivergedError
from codrl_mj.tasks import TASKS
from codrl_mj.validation import energy, validate
from codrl_mj.validation.energy import Meter, hill_potential, record_energies
from tests.validation.mutations import euler, failed, once, rusty, scaled, scaled_motor, wrong_model

pytestmark = pytest.mark.usefixtures("bare_engine")

HILL_TASKS = ("mountain_car", "mountain_car_continuous")
STEPS = "winding, step by step"


def orders(task, *balances):
    return {
        f"order, {balance} balance, {name}"
        for balance in balances
        for name in TASKS[task].integrators
    }


def failures(monkeypatch, task):
    """Return the names of the checks that fail because of a fault in MuJoCo."""
    # Analytic runs do not depend on the fault, so they are computed only once.
    monkeypatch.setattr(energy, "record_energies", once(energy.record_energies, MujocoPhysics))
    return failed(energy.checks(task, quick=True))


FAULTS = [
    # Each row has the task, the model's fault, and the checks that fail: exactly or at least these.
    ("pendulum", scaled_motor("inductance", 1.01), "==", (STEPS, "electrical", "whole")),
    ("pendulum", scaled_motor("resistance", 1.01), "==", (STEPS, "electrical", "whole")),
    ("pendulum", scaled_motor("back_emf_constant", -1.0), ">=", (STEPS, "electrical", "whole")),
    ("mountain_car", scaled_motor("back_emf_constant", -1.0), ">=", (STEPS, "electrical", "whole")),
    # The recorded force is the force that acts, so the mechanical balance holds.
    ("pendulum", scaled_motor("torque_constant", 1.02), "==", ("whole",)),
    # Speed and torque are both wrong, as with another gear, so no energy is lost.
    ("pendulum", scaled("actuator_gear", 1.02), "==", (STEPS, "electrical", "mechanical")),
    ("pendulum", scaled("body_mass", 1.05), ">=", ("mechanical",)),
    ("acrobot", scaled("body_mass", 1.05), ">=", ("mechanical",)),
    ("mountain_car", scaled("jnt_user", 1.02, (0, GRAVITY)), ">=", ("mechanical",)),
    ("mountain_car_continuous", scaled("jnt_user", 1.02, (0, GRAVITY)), ">=", ("mechanical",)),
    ("pendulum", rusty, "==", ("mechanical", "whole")),
    ("acrobot", euler, ">=", ("mechanical",)),
]


@pytest.mark.parametrize(("task", "fault", "relation", "must_fail"), FAULTS)
def test_wrong_model_fails_the_affected_balances(monkeypatch, task, fault, relation, must_fail):
    wrong_model(monkeypatch, fault)
    failing = failures(monkeypatch, task)
    expected = orders(task, *(set(must_fail) - {STEPS})) | ({STEPS} & set(must_fail))
    assert failing == expected if relation == "==" else failing >= expected


def test_wrong_force_in_the_analytic_physics_fails(monkeypatch):
    """Check a force that is 2 % larger than the recorded force."""
    make = AnalyticPhysics.__init__

    def stronger(self, *arguments, **options):
        make(self, *arguments, **options)
        drive = self.reference_env

        class Stronger:
            def __call__(self, state, force, timestep, integrator):
                return drive(state, 1.02 * force, timestep, integrator)

        self.reference_env = Stronger()

    monkeypatch.setattr(AnalyticPhysics, "__init__", stronger)
    checks = {
        check.name: check for check in energy.checks("pendulum", quick=True) if not check.passed
    }
    assert checks.keys() == orders("pendulum", "mechanical", "whole")
    assert all(check.where.startswith("analytic") for check in checks.values())


def test_diverging_run_is_a_failed_check(monkeypatch):
    def diverge(self, force):
        raise SimulationDivergedError("it diverged")

    monkeypatch.setattr(MujocoPhysics, "step", diverge)
    checks = validate("pendulum", quick=True, groups=["energy"]).checks
    assert [check.name for check in checks] == [STEPS, "runs to its end"]
    assert all(not check.passed and "it diverged" in check.where for check in checks)


# -- the ledger ------------------------------------------------------------------------------------


def test_meter_equals_textbook_energies():
    generator = np.random.default_rng(0)
    pendulum, cartpole = Meter(TASKS["pendulum"]), Meter(TASKS["cartpole"])
    for _ in range(10):
        x, v, angle, speed = generator.uniform(-2, 2, 4)
        # A rod of 1 kg and 1 m has I = 1/3; the model's has 1e-5 kg*m^2 more about its length.
        expected = speed**2 / 6 + 5 * np.cos(angle)
        assert pendulum(np.array([angle, speed])) == pytest.approx(expected, abs=1e-4)
        kinetic = 0.55 * v**2 + 0.05 * v * speed * np.cos(angle) + (0.1 * 1.0 / 3) * speed**2 / 2
        difference = cartpole(np.array([x, v, angle, speed])) - cartpole(np.zeros(4))
        assert difference == pytest.approx(
            kinetic + 0.1 * 9.8 * 0.5 * (np.cos(angle) - 1), abs=1e-12
        )


@pytest.mark.parametrize("task", HILL_TASKS)
def test_hill_potential_is_the_integral_of_gymnasiums_force(task):
    potential = hill_potential(TASKS[task], 2.0)
    x = np.linspace(-1.0, 0.4, 29)
    expected = 2.0 * 0.0025 / 3 * np.sin(3 * x)
    measured = potential(x)
    np.testing.assert_allclose(measured - measured[0], expected - expected[0], rtol=0, atol=1e-14)


def test_energies_of_an_accelerating_motor_have_the_right_signs():
    """Check that a motor that accelerates a load draws more energy than its winding heats."""
    task = TASKS["mountain_car"]
    ledger = record_energies(
        MujocoPhysics, task, task.paper, np.array([-0.5, 0.0]), np.ones(20), 20, "semi-implicit", 20
    )
    assert ledger.supplied[-1] > ledger.copper[-1] > 0
    assert ledger.magnetic[-1] > 0
    assert ledger.shaft[-1] > 0
    assert abs(ledger.residual("whole")[-1]) < 0.05 * ledger.supplied[-1]
