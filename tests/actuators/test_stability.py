"""Stability of the discrete loop: against hand-derived polynomials, published numbers and the loop itself."""

import dataclasses
import math
import re

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from codrl_mj.actuators import (
    Actuator,
    CurrentLoop,
    Inputs,
    Motor,
    check_stable,
    parameters_type,
    spectral_radii,
    spectral_radius,
)
from codrl_mj.actuators.stability import MARGIN, stability_radii
from tests.actuators.strategies import actuators, between, motors

# The paper's gains and steps
PENDULUM = Actuator(controller=CurrentLoop(kp=1.0, ki=20.0, kd=1e-6))
MOUNTAIN_CAR = Actuator(controller=CurrentLoop(kp=1.0, ki=1.0, kd=1e-2))
MOUNTAIN_CAR_TIGHT = Actuator(controller=CurrentLoop(kp=2.0, ki=10.0, kd=1e-6))
MOUNTAIN_CAR_CONTINUOUS = Actuator(controller=CurrentLoop(kp=0.1, ki=10.0, kd=1e-3))
ACROBOT = Actuator(controller=CurrentLoop(kp=1.0, ki=10.0, kd=1e-6))
CARTPOLE = Actuator(Motor(arm_radius=0.15), CurrentLoop(kp=4.3, ki=1.0, kd=1e-6, kff=0.6))

# actuator, step [s], spectral radius, the kd at which the loop turns unstable
PAPER_LOOPS = [
    (PENDULUM, 0.05, 0.500, 0.038),
    (MOUNTAIN_CAR, 0.05, 0.975, 0.049),
    (MOUNTAIN_CAR_TIGHT, 0.05, 0.843, 0.019),
    (MOUNTAIN_CAR_CONTINUOUS, 0.05, 0.676, 0.066),
    (ACROBOT, 0.02, 0.872, 0.079),
    (CARTPOLE, 0.02, 0.996, 0.047),
]

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


def closed_loop_matrix(actuator, timestep):
    """Transition matrix of the unsaturated loop over one mechanical step, read off `advance` itself.

    Only the states that some gain reads are part of the loop: the current always, the integral if ki > 0 and the
    previous error if kd > 0.
    """
    parameters = parameters_type(Actuator)(*actuator.numbers)._replace(
        max_voltage=np.inf, supply_voltage=np.inf, supply_resistance=0.0, current_bias=0.0, current_noise=0.0
    )
    states = [0, *[1] * (actuator.controller.ki > 0), *[2] * (actuator.controller.kd > 0)]
    rest = Inputs(0.0, 0.0, 0.0, 0.0, 0.0)
    units = np.eye(3)[states]
    after = [actuator.advance(parameters, timestep, actuator.State(*unit), rest)[0] for unit in units]
    return np.array(after).T[states]


def _with(actuator, **gains):
    return dataclasses.replace(actuator, controller=dataclasses.replace(actuator.controller, **gains))


def _polynomial(actuator, dt):
    """Characteristic polynomial of the PID loop, expanded by hand from its 3 x 3 matrix.

    With a = dt/L: i' = A i + a kI I - (kD/L) e_old, I' = I - dt i, e_old' = -i, A = 1 - a (R + kP + kI dt + kD/dt).
    Where kI or kD is zero the root of the state that nothing reads (1 and 0) is divided out.
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


@given(motors, between(0, 20), timesteps)
def test_a_proportional_loop_has_the_pole_of_the_closed_form(motor, kp, dt):
    actuator = Actuator(motor, CurrentLoop(kp=kp))
    expected = abs(1.0 - (motor.resistance + kp) * dt / motor.inductance)
    assert spectral_radius(actuator, dt) == pytest.approx(expected, rel=1e-12, abs=1e-14)


@given(motors, plain_loops, timesteps)
def test_the_spectral_radius_is_that_of_the_hand_derived_polynomial(motor, loop, dt):
    actuator = Actuator(motor, loop)
    polynomial = _polynomial(actuator, dt)
    # the radius itself can be ill-conditioned at a double root; that it is a root is not
    values = np.linalg.eigvals(closed_loop_matrix(actuator, dt))
    assert len(values) == len(polynomial) - 1
    for value in values:
        scale = np.polyval(np.abs(polynomial), abs(value))
        assert abs(np.polyval(polynomial, value)) <= 1e-11 * scale
    radius = np.abs(np.roots(polynomial)).max()
    assert spectral_radius(actuator, dt) == pytest.approx(radius, rel=1e-5, abs=1e-7)


@pytest.mark.parametrize(("actuator", "dt", "radius", "_"), PAPER_LOOPS)
def test_the_papers_loops_have_their_published_radius(actuator, dt, radius, _):
    assert round(spectral_radius(actuator, dt), 3) == radius
    check_stable(actuator, dt)


@pytest.mark.parametrize(("actuator", "dt", "_", "limit"), PAPER_LOOPS)
def test_the_papers_loops_turn_unstable_at_their_published_derivative_gain(actuator, dt, _, limit):
    assert spectral_radius(_with(actuator, kd=limit - 0.001), dt) < 1.0
    assert spectral_radius(_with(actuator, kd=limit + 0.001), dt) > 1.0
    low, high = limit - 0.001, limit + 0.001
    while high - low > 1e-9:
        middle = (low + high) / 2
        low, high = (middle, high) if spectral_radius(_with(actuator, kd=middle), dt) < 1.0 else (low, middle)
    assert low == pytest.approx(limit, abs=0.0005 + 1e-8)  # published to three decimals


@pytest.mark.parametrize(("actuator", "dt", "radius"), [(PENDULUM, 0.1, 2.4), (CARTPOLE, 0.05, 1.67)])
def test_the_papers_gains_are_unstable_at_a_longer_step(actuator, dt, radius):
    assert spectral_radius(actuator, dt) == pytest.approx(radius, abs=0.02)
    with pytest.raises(ValueError, match="unstable"):
        check_stable(actuator, dt)


@given(actuators, timesteps, st.integers(2, 6))
def test_substeps_multiply_the_loop_of_one_substep(actuator, dt, count):
    one = closed_loop_matrix(_with(actuator, substeps=1), dt / count)
    many = closed_loop_matrix(_with(actuator, substeps=count), dt)
    expected = np.linalg.matrix_power(one, count)
    np.testing.assert_allclose(many, expected, rtol=1e-9, atol=1e-11 * np.linalg.norm(one) ** count + 1e-13)


@given(actuators, timesteps, st.integers(0, 2**31))
def test_the_simulated_loop_decays_where_stable_and_grows_where_not(actuator, dt, seed):
    actuator = _with(actuator, max_voltage=math.inf)
    radius = spectral_radius(actuator, dt)
    assume(not 0.97 < radius < 1.03)
    parameters, rest = parameters_type(Actuator)(*actuator.numbers), Inputs(0.0, 0.0, 0.0, 0.0, 0.0)
    loop = actuator.controller
    read = [True, loop.ki > 0, loop.kd > 0]
    state = np.where(read, np.random.default_rng(seed).uniform(0.5, 1.0, 3), 0.0)
    start = np.linalg.norm(state)
    for _ in range(2000):
        state = np.array(actuator.advance(parameters, dt, Actuator.State(*state), rest)[0]) * read
        size = np.linalg.norm(state)
        if not 1e-9 < size / start < 1e9:
            break
    assert size < 1e-3 * start if radius < 1.0 else size > 1e3 * start


def test_an_integral_that_no_gain_reads_does_not_make_a_loop_marginal():
    # the unread integral would put a pole at 1 exactly
    check_stable(Actuator(controller=CurrentLoop(kp=1.0, ki=0.0)), 0.01)


@pytest.mark.parametrize("field", ["max_voltage", "kff", "bemf_compensation"])
def test_what_is_not_feedback_does_not_move_the_poles(field):
    changed = _with(CARTPOLE, **{field: {"max_voltage": 0.1, "kff": 2.0, "bemf_compensation": False}[field]})
    np.testing.assert_array_equal(closed_loop_matrix(changed, 0.02), closed_loop_matrix(CARTPOLE, 0.02))


def test_a_radius_of_exactly_one_is_refused():
    actuator = Actuator(Motor(resistance=1.0, inductance=0.125), CurrentLoop(kp=1.0))
    assert spectral_radius(actuator, 0.125) == 1.0  # |1 - 2|
    with pytest.raises(ValueError, match="spectral radius 1, must be < 1"):
        check_stable(actuator, 0.125)


def _refusal(actuator, dt):
    with pytest.raises(ValueError, match="unstable") as refused:
        check_stable(actuator, dt)
    return str(refused.value)


@given(actuators, timesteps)
def test_an_unstable_loop_is_refused_with_its_radius_and_a_remedy_that_works(actuator, dt):
    radius = spectral_radius(actuator, dt)
    if radius < 1.0:
        check_stable(actuator, dt)
        return
    message = _refusal(actuator, dt)
    assert f"a step of {dt:g} s" in message
    assert f"spectral radius {radius:.4g}, must be < 1" in message
    assert "allow_unstable=True" in message
    loop = actuator.controller
    proposed = re.search(r"Set controller\.substeps = (\d+)", message)
    if proposed:
        substeps = int(proposed.group(1))
        assert substeps > loop.substeps
        check_stable(_with(actuator, substeps=substeps), dt)
        check_stable(actuator, dt * loop.substeps / substeps)  # "or shorten the step"
        if substeps > 2 * loop.substeps:  # and it is no larger than it needs to be
            assert spectral_radius(_with(actuator, substeps=substeps // 2), dt) >= 1.0
    else:
        assert f"Lower the gains (kp = {loop.kp:g}, ki = {loop.ki:g}, kd = {loop.kd:g})" in message
        for doubling in range(1, 11):
            assert spectral_radius(_with(actuator, substeps=loop.substeps * 2**doubling), dt) >= 1.0


@pytest.mark.parametrize(("actuator", "dt"), [(PENDULUM, 0.1), (CARTPOLE, 0.05)])
def test_the_remedy_for_the_papers_gains_at_a_longer_step_is_two_substeps(actuator, dt):
    assert "Set controller.substeps = 2" in _refusal(actuator, dt)
    check_stable(_with(actuator, substeps=2), dt)


def test_a_derivative_gain_beyond_the_inductance_is_unstable_at_any_step_and_the_remedy_is_lower_gains():
    # the product of a PD loop's poles is -kd/L whatever the step
    actuator = Actuator(Motor(inductance=0.1), CurrentLoop(kp=1.0, kd=0.15))
    assert "Lower the gains (kp = 1, ki = 0, kd = 0.15): more substeps do not help" in _refusal(actuator, 0.02)
    check_stable(_with(actuator, kd=0.03), 0.02)


# -- many at once -------------------------------------------------------------------------------------------


@settings(max_examples=40)
@given(st.lists(actuators, min_size=1, max_size=4), timesteps)
def test_many_radii_are_each_the_one_to_the_last_bit(several, dt):
    radii = spectral_radii(Actuator, np.array([one.numbers for one in several]), dt)
    np.testing.assert_array_equal(radii, [spectral_radius(one, dt) for one in several])


@given(actuators, timesteps)
def test_the_radius_is_that_of_the_matrix(actuator, dt):
    # of one substep: the eigenvalues of a power lose more digits than the power of the eigenvalues
    one = _with(actuator, substeps=1)
    values = np.linalg.eigvals(closed_loop_matrix(one, dt))
    assert spectral_radius(one, dt) == pytest.approx(np.abs(values).max(), rel=1e-6, abs=1e-6)


@settings(max_examples=30)
@given(st.lists(actuators, min_size=1, max_size=10), timesteps)
def test_the_quick_test_is_below_one_exactly_where_the_radii_are(several, dt):
    numbers = np.array([one.numbers for one in several])
    quick, radii = stability_radii(Actuator, numbers, dt), spectral_radii(Actuator, numbers, dt)
    np.testing.assert_array_equal(quick < 1.0, radii < 1.0)


@given(motors, st.sampled_from([-1.0, 1.0]), st.integers(-3, 3), timesteps)
def test_the_quick_test_asks_the_eigenvalues_on_the_edge(motor, pole, nudge, dt):
    """A proportional loop whose pole is +-1, give or take some rounding errors."""
    kp = (1.0 - pole) * motor.inductance / dt - motor.resistance
    assume(kp >= 0.0)
    numbers = np.array([Actuator(motor, CurrentLoop(kp=kp + nudge * np.spacing(max(kp, 1.0)))).numbers])
    np.testing.assert_array_equal(stability_radii(Actuator, numbers, dt), spectral_radii(Actuator, numbers, dt))


def test_the_quick_test_asks_nobody_where_the_case_is_clear(monkeypatch):
    stable, unstable = Actuator(), Actuator(controller=CurrentLoop(kp=1e4))
    monkeypatch.setattr("codrl_mj.actuators.stability.spectral_radii", None)
    numbers = np.array([stable.numbers, unstable.numbers])
    np.testing.assert_array_equal(stability_radii(Actuator, numbers, 0.01), [0.0, np.inf])
    assert 0.0 < MARGIN < 1e-6


@pytest.mark.parametrize("field", ["kp", "ki", "kd"])
def test_gains_that_overflow_are_unstable_at_any_number_of_substeps(field):
    numbers = np.array([_with(Actuator(), **{field: 1e300}, substeps=count).numbers for count in (1, 4)])
    for radii in (stability_radii, spectral_radii):
        assert not (radii(Actuator, numbers, 0.01) < 1.0).any()
