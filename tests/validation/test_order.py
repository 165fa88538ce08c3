"""Tests of fitted slopes, their intervals, and checks of orders of convergence."""

import math

import numpy as np
import pytest
from scipy import optimize

from codrl_mj.validation.table import (
    ConvergenceSeries,
    evaluate_cases,
    fit_slope,
    order_case,
    order_check,
)

STEPS = 0.1 / 2.0 ** np.arange(5)


def check(errors, promised):
    return evaluate(ConvergenceSeries("family", STEPS, np.asarray(errors)), promised)


def evaluate(series, promised):
    return evaluate_cases(
        order_check("name", "oracle"),
        {},
        [order_case(promised, [series], "title", "step [s]", "error [m]")],
    )


@pytest.mark.parametrize("power", [1.0, 4.0, -1.0])
def test_pure_power_has_its_exponent_and_no_interval(power):
    slope, half_width = fit_slope(STEPS, 3.0 * STEPS**power)
    assert slope == pytest.approx(power)
    assert half_width < 1e-10
    assert check(3.0 * STEPS**power, power).passed


def test_interval_equals_scipys_curve_fit():
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
def test_errors_of_another_order_fail(errors):
    assert not check(errors, 1.0).passed


@pytest.mark.parametrize(
    ("errors", "passed", "description"),
    [
        # Only two errors are above rounding.
        ([1.2e-13, 7.5e-15, 2e-16, 1e-16, 3e-16], True, "exact to rounding"),
        ([0.0, 0.0, 0.0, 0.0, 0.0], True, "exact to rounding"),
        # The first error is larger than the order allows.
        (
            [1e-11, 7.5e-16, 2e-16, 1e-16, 3e-16],
            False,
            "exact to rounding",
        ),
        ([math.nan, 1e-16, 1e-16, 1e-16, 1e-16], False, "exact to rounding"),
        # The last error is rounding and not fitted.
        ([1.6e-10, 1e-11, 6.25e-13, 4e-14, 9e-16], True, "slope 3.99"),
        ([1e-13, 9e-14, 8e-14, 7e-14, 6e-14], False, "slope 0.18"),
    ],
)
def test_order_is_not_fitted_to_rounding(errors, passed, description):
    series = ConvergenceSeries("family", STEPS, np.array(errors), 1e-15)
    result = evaluate(series, 4.0)
    assert result.passed == passed
    assert description in result.where


def test_scattered_fit_fails_even_if_its_slope_is_right():
    errors = STEPS * np.array([1.0, 1.5, 0.6, 1.5, 1.0])
    assert fit_slope(STEPS, errors)[0] == pytest.approx(1.0, abs=0.1)
    assert not check(errors, 1.0).passed


def test_promised_slope_is_drawn_beside_the_errors():
    (plot,) = check(2 * STEPS, 1.0).plots
    assert plot.x_log
    assert plot.y_log
    measured, promise = plot.curves
    assert promise.reference
    assert not measured.reference
    np.testing.assert_allclose(promise.y, measured.y / 2)
