"""Stability of the discrete loop, against polynomials, published numbers and the loop itself."""

import dataclasses
import re

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from codrl_mj.actuators import (
    CurrentLoop,
    DCMotorActuator,
    Inputs,
    Motor,
    check_stable,
    parameters_type,
    spectral_radii,
    spectral_radius,
)
from codrl_mj.actuators.stability import stability_radii
from tests.actuators.strategies import actuators, between, motors

timesteps = between(1e-3, 0.1)
plain_loops = st.builds(
    CurrentLoop,
    kp=between(0, 20),
    ki=st.just(0.0) | between(0.01, 50),
    kd=st.just(0.0) | between(1e-4, 0.2),
    kff=between(0, 3),
    max_voltage=between(0.1, 100),
    bemf_compensation=st.booleans(),
)


def with_gains(actuator, **gains):
    return dataclasses.replace(
        actuator, controller=dataclasses.replace(actuator.controller, **gains)
    )


def electrical_matrix(actuator, timestep):
    """Return the transition matrix of the unsaturated loop over one electrical step.

    It is determined by calls of `advance`. Only the states that some gain reads are part of the
    loop: the current always, the integral if ki > 0 and the previous error if kd > 0.
    """
    parameters = parameters_type(DCMotorActuator)(*actuator.parameter_values)._replace(
        max_voltage=np.inf, substeps=1
    )
    states = [0, *[1] * (actuator.controller.ki > 0), *[2] * (actuator.controller.kd > 0)]
    rest, units = Inputs(0.0, 0.0, 0.0, 0.0, 0.0), np.eye(3)[states]
    dt = timestep / actuator.controller.substeps
    after = [actuator.advance(parameters, dt, actuator.State(*unit), rest)[0] for unit in units]
    return np.array(after).T[states]


def polynomial_of(actuator, dt):
    """Return the characteristic polynomial of the PID loop, expanded by hand from its matrix.

    With a = dt/L: i' = A i + a kI I - (kD/L) e_old, I' = I - dt i, e_old' = -i, A = 1 - a (R + kP +
    kI dt + kD/dt). If kI or kD is zero, the root of the state that nothing reads (1 and 0) is
    divided out.
    """
    motor, loop = actuator.motor, actuator.controller
    a = dt / motor.inductance
    big_a = 1.0 - a * (motor.resistance + loop.kp + loop.ki * dt + loop.kd / dt)
    b, c = a * loop.ki, -loop.kd / motor.inductance
    if loop.ki and loop.kd:
        return [1.0, -(big_a + 1.0), big_a + b * dt + c, -c]
    if loop.ki:
        return [1.0, -(big_a + 1.0), big_a + b * dt]
    if loop.kd:
        return [1.0, -big_a, c]
    return [1.0, -big_a]


@given(motors, plain_loops, timesteps)
def test_the_spectral_radius_is_that_of_the_polynomial(motor, loop, dt):
    actuator = DCMotorActuator(motor, loop)
    polynomial = polynomial_of(actuator, dt)
    # A double root can be ill-conditioned, but it still satisfies the polynomial.
    values = np.linalg.eigvals(electrical_matrix(actuator, dt))
    assert len(values) == len(polynomial) - 1
    for value in values:
        scale = np.polyval(np.abs(polynomial), abs(value))
        assert abs(np.polyval(polynomial, value)) <= 1e-11 * scale
    radius = np.abs(np.roots(polynomial)).max()
    assert spectral_radius(actuator, dt) == pytest.approx(radius, rel=1e-5, abs=1e-7)


@given(actuators, timesteps)
def test_the_radius_is_that_of_the_matrix_to_the_power_of_the_substeps(actuator, dt):
    radius, count = (
        np.abs(np.linalg.eigvals(electrical_matrix(actuator, dt))).max(),
        actuator.controller.substeps,
    )
    assert spectral_radius(actuator, dt) == pytest.approx(radius**count, rel=1e-6 * count, abs=1e-6)


# -- the paper's gains, at its steps and at longer ones --------------------------------------------

PENDULUM = DCMotorActuator(controller=CurrentLoop(kp=1.0, ki=20.0, kd=1e-6))
CARTPOLE = DCMotorActuator(Motor(arm_radius=0.15), CurrentLoop(kp=4.3, ki=1.0, kd=1e-6, kff=0.6))
# Name: actuator, step [s], spectral radius, the kd at which the loop becomes unstable.
PAPER_LOOPS = {
    "pendulum": (PENDULUM, 0.05, 0.500, 0.038),
    "mountain car": (
        DCMotorActuator(controller=CurrentLoop(kp=1.0, ki=1.0, kd=1e-2)),
        0.05,
        0.975,
        0.049,
    ),
    "mountain car, tight": (
        DCMotorActuator(controller=CurrentLoop(kp=2.0, ki=10.0, kd=1e-6)),
        0.05,
        0.843,
        0.019,
    ),
    "mountain car, continuous": (
        DCMotorActuator(controller=CurrentLoop(kp=0.1, ki=10.0, kd=1e-3)),
        0.05,
        0.676,
        0.066,
    ),
    "acrobot": (
        DCMotorActuator(controller=CurrentLoop(kp=1.0, ki=10.0, kd=1e-6)),
        0.02,
        0.872,
        0.079,
    ),
    "cart-pole": (CARTPOLE, 0.02, 0.996, 0.047),
}


@pytest.mark.parametrize("name", PAPER_LOOPS)
def test_the_papers_loops_have_the_published_radius_and_gain_limit(name):
    actuator, dt, radius, limit = PAPER_LOOPS[name]
    assert round(spectral_radius(actuator, dt), 3) == radius
    check_stable(actuator, dt)
    low, high = limit - 0.001, limit + 0.001
    assert (
        spectral_radius(with_gains(actuator, kd=low), dt)
        < 1.0
        < spectral_radius(with_gains(actuator, kd=high), dt)
    )
    while high - low > 1e-9:
        middle = (low + high) / 2
        low, high = (
            (middle, high)
            if spectral_radius(with_gains(actuator, kd=middle), dt) < 1.0
            else (low, middle)
        )
    # The value is published to three decimals.
    assert low == pytest.approx(limit, abs=0.0005 + 1e-8)


@pytest.mark.parametrize(
    ("actuator", "dt", "radius"), [(PENDULUM, 0.1, 2.4), (CARTPOLE, 0.05, 1.67)]
)
def test_two_substeps_stabilize_the_papers_gains_at_a_longer_step(actuator, dt, radius):
    assert spectral_radius(actuator, dt) == pytest.approx(radius, abs=0.02)
    with pytest.raises(ValueError, match=r"unstable.*Set controller\.substeps = 2"):
        check_stable(actuator, dt)
    check_stable(with_gains(actuator, substeps=2), dt)


def test_raises_if_the_radius_is_exactly_one():
    actuator = DCMotorActuator(Motor(resistance=1.0, inductance=0.125), CurrentLoop(kp=1.0))
    assert spectral_radius(actuator, 0.125) == 1.0  # |1 - 2|
    with pytest.raises(ValueError, match="spectral radius 1, must be < 1"):
        check_stable(actuator, 0.125)


@given(actuators, timesteps)
def test_raises_with_the_radius_and_a_remedy_that_works(actuator, dt):
    radius, loop = spectral_radius(actuator, dt), actuator.controller
    if radius < 1.0:
        check_stable(actuator, dt)
        return
    message = re.escape(
        f"unstable at a step of {dt:g} s: spectral radius {radius:.4g}, must be < 1. "
    )
    with pytest.raises(ValueError, match=f"{message}.*allow_unstable=True") as refused:
        check_stable(actuator, dt)
    proposed = re.search(r"Set controller\.substeps = (\d+)", str(refused.value))
    if proposed:
        substeps = int(proposed.group(1))
        assert substeps > loop.substeps
        check_stable(with_gains(actuator, substeps=substeps), dt)
        # The other remedy is a shorter step.
        check_stable(actuator, dt * loop.substeps / substeps)
        # The number of substeps is not larger than necessary.
        if substeps > 2 * loop.substeps:
            assert spectral_radius(with_gains(actuator, substeps=substeps // 2), dt) >= 1.0
    else:
        remedy = (
            f"Lower the gains (kp = {loop.kp:g}, ki = {loop.ki:g}, kd = {loop.kd:g}): more substeps"
            " do not help"
        )
        assert remedy in str(refused.value)
        for doubling in range(1, 11):
            assert (
                spectral_radius(with_gains(actuator, substeps=loop.substeps * 2**doubling), dt)
                >= 1.0
            )


# -- many actuators at once ------------------------------------------------------------------------


@settings(max_examples=40)
@given(st.lists(actuators, min_size=1, max_size=8), timesteps)
def test_many_radii_equal_single_ones_and_agree_with_the_fast_test(many, dt):
    numbers = np.array([actuator.parameter_values for actuator in many])
    radii = spectral_radii(DCMotorActuator, numbers, dt)
    np.testing.assert_array_equal(radii, [spectral_radius(actuator, dt) for actuator in many])
    np.testing.assert_array_equal(stability_radii(DCMotorActuator, numbers, dt) < 1.0, radii < 1.0)


@given(motors, st.sampled_from([-1.0, 1.0]), st.integers(-3, 3), timesteps)
def test_the_fast_test_uses_eigenvalues_in_doubtful_cases(motor, pole, nudge, dt):
    """Check a proportional loop whose pole is +-1 within some rounding errors."""
    kp = (1.0 - pole) * motor.inductance / dt - motor.resistance
    assume(kp >= 0.0)
    numbers = np.array(
        [
            DCMotorActuator(
                motor, CurrentLoop(kp=kp + nudge * np.spacing(max(kp, 1.0)))
            ).parameter_values
        ]
    )
    np.testing.assert_array_equal(
        stability_radii(DCMotorActuator, numbers, dt), spectral_radii(DCMotorActuator, numbers, dt)
    )


def test_the_fast_test_needs_no_eigenvalues_in_clear_cases(monkeypatch):
    monkeypatch.setattr("codrl_mj.actuators.stability.spectral_radii", None)
    numbers = np.array(
        [DCMotorActuator(controller=CurrentLoop(kp=kp)).parameter_values for kp in (1.0, 1e4)]
    )
    np.testing.assert_array_equal(stability_radii(DCMotorActuator, numbers, 0.01), [0.0, np.inf])


@pytest.mark.parametrize("field", ["kp", "ki", "kd"])
def test_gains_that_overflow_are_unstable_at_any_number_of_substeps(field):
    numbers = np.array(
        [
            with_gains(DCMotorActuator(), **{field: 1e308}, substeps=count).parameter_values
            for count in (1, 4)
        ]
    )
    for radii in (stability_radii, spectral_radii):
        assert not (radii(DCMotorActuator, numbers, 0.01) < 1.0).any()
