"""Slopes are fitted with honest intervals, and a check of an order fails on what is not of that order."""

import math

import numpy as np
import pytest
from scipy import optimize

from codrl_mj.validation.table import ConvergenceSeries, fit_slope, order_case, order_check, evaluate_cases

STEPS = 0.1 / 2.0 ** np.arange(5)


def check(errors, promised):
    return distance_from(ConvergenceSeries("family", STEPS, np.asarray(errors)), promised)


def distance_from(family, promised):
    return evaluate_cases(
        order_check("name", "oracle"),
        {},
        [order_case(promised, [family], "title", "step [s]", "error [m]")],
    )


@pytest.mark.parametrize("power", [1.0, 4.0, -1.0])
def test_a_pure_power_has_its_exponent_and_no_interval(power):
    slope, half_width = fit_slope(STEPS, 3.0 * STEPS**power)
    assert slope == pytest.approx(power)
    assert half_width < 1e-10
    assert check(3.0 * STEPS**power, power).passed


def test_the_interval_is_that_of_scipys_curve_fit():
    errors = STEPS * np.array([1.1, 0.9, 1.05, 0.97, 1.2])
    _, covariance = optimize.curve_fit(lambda x, a, b: a * x + b, np.log(STEPS), np.log(errors))
    assert fit_slope(STEPS, errors)[1] == pytest.approx(
        3.182446 * math.sqrt(covariance[0, 0]), rel=1e-4
    )


@pytest.mark.parametrize(
    "errors",
    [
        STEPS**2,
        STEPS + 0.02,
        np.full(5, 1e-3),
        [*STEPS[:4], math.nan],
        [*STEPS[:4], 0.0],
        [*STEPS[:4], math.inf],
    ],
    ids=["another order", "an offset", "constant", "nan", "zero", "infinite"],
)
def test_what_is_not_of_the_promised_order_fails(errors):
    assert not check(errors, 1.0).passed


@pytest.mark.parametrize(
    ("errors", "passed", "said"),
    [
        ([1.2e-13, 7.5e-15, 2e-16, 1e-16, 3e-16], True, "exact to rounding"),  # two above it
        ([0.0, 0.0, 0.0, 0.0, 0.0], True, "exact to rounding"),
        (
            [1e-11, 7.5e-16, 2e-16, 1e-16, 3e-16],
            False,
            "exact to rounding",
        ),  # more than the order leaves
        ([math.nan, 1e-16, 1e-16, 1e-16, 1e-16], False, "exact to rounding"),
        ([1.6e-10, 1e-11, 6.25e-13, 4e-14, 9e-16], True, "slope 3.99"),  # without the last
        ([1e-13, 9e-14, 8e-14, 7e-14, 6e-14], False, "slope 0.18"),
    ],
)
def test_an_order_is_not_fitted_to_rounding(errors, passed, said):
    family = ConvergenceSeries("family", STEPS, np.array(errors), 1e-15)
    found = distance_from(family, 4.0)
    assert found.passed == passed
    assert said in found.where


def test_a_scattered_fit_fails_though_its_slope_is_right():
    errors = STEPS * np.array([1.0, 1.5, 0.6, 1.5, 1.0])
    assert fit_slope(STEPS, errors)[0] == pytest.approx(1.0, abs=0.1)
    assert not check(errors, 1.0).passed


def test_the_promised_slope_is_drawn_beside_the_errors():
    (plot,) = check(2 * STEPS, 1.0).plots
    assert plot.x_log
    assert plot.y_log
    measured, promise = plot.curves
    assert promise.reference
    assert not measured.reference
    np.testing.assert_allclose(promise.y, measured.y / 2)
