"""Simulation of a winding and a shaft, compared with scipy's integrators and closed forms."""

import types

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from codrl_mj.identify.log import Log
from codrl_mj.identify.parameters import ShaftParameters
from codrl_mj.identify.result import closed_loop_error
from codrl_mj.identify.simulation import simulate_servo, simulate_shaft, simulate_winding

STILL = ShaftParameters(0.2, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 1.0, 2.0, 0.0, 1.0, 0.0)


def simulate_constant(shaft, times, inputs, position=0.0, speed=0.0):
    return simulate_shaft(
        times,
        np.broadcast_to(inputs, times.shape).astype(float),
        np.zeros(len(times)),
        position,
        speed,
        shaft,
    )


def test_the_winding_is_exact_with_uneven_steps():
    random = np.random.default_rng(0)
    times = np.cumsum(random.uniform(1e-4, 2e-3, 40))
    volts, speeds = random.uniform(-5.0, 5.0, 40), random.uniform(-50.0, 50.0, 40)
    currents = simulate_winding(times, volts, speeds, 0.3, 1.2, 6e-4, 0.05)
    expected = 0.3
    for row in range(39):
        duration = times[row + 1] - times[row]
        slope = lambda _, current, row=row: (volts[row] - 1.2 * current - 0.05 * speeds[row]) / 6e-4  # noqa: E731
        expected = solve_ivp(slope, (0.0, duration), [expected], rtol=1e-10, atol=1e-12).y[0, -1]
        assert currents[row + 1] == pytest.approx(expected, abs=1e-7)


@pytest.mark.parametrize(("torque", "slides"), [(0.029, False), (0.031, True)])
def test_a_shaft_breaks_loose_beyond_coulomb_and_stribeck_friction_together(torque, slides):
    shaft = STILL._replace(coulomb=0.01, stribeck_friction=0.02, stribeck_speed=1.0)
    positions, _ = simulate_constant(shaft, np.linspace(0.0, 0.5, 51), torque)
    assert bool(positions[-1] > 0.0) is slides


def test_a_voltage_brakes_by_its_back_emf():
    shaft = STILL._replace(gain=0.05, braking=0.1)
    _, speeds = simulate_constant(shaft, np.linspace(0.0, 5.0, 5001), 6.0)
    # The time constant is J/(kT*kE/R) = 2 s, and the final speed 0.3/0.1.
    assert speeds[-1] == pytest.approx(3.0 * (1.0 - np.exp(-2.5)), rel=1e-6)


def test_friction_and_braking_end_where_torques_balance_for_any_step():
    """The final balance is 0.05*6 = 0.1 + (1 + 9)*speed, with a time constant of 20 steps."""
    times = np.linspace(0.0, 1.0, 1001)
    shaft = STILL._replace(gain=0.05, braking=9.0, viscous=1.0, coulomb=0.1)
    assert simulate_constant(shaft, times, 6.0)[1][-1] == pytest.approx(0.02, rel=1e-9)


def test_a_servo_holds_a_load_by_its_proportional_law():
    times = np.linspace(0.0, 20.0, 4001)
    shaft = STILL._replace(gravity=1.0, viscous=1.0)
    targets, limits = np.full(4001, 0.5), np.full(4001, 5.0)
    position = simulate_servo(times, targets, limits, 4.0, 0.0, 0.0, shaft)[-1]
    assert 4.0 * (0.5 - position) == pytest.approx(np.sin(position), rel=1e-6)


def test_a_supply_limits_the_input_of_a_servo_only_if_it_is_a_voltage():
    """The number of a torque may exceed that of the supply's voltage: they are not compared."""
    times = np.linspace(0.0, 20.0, 4001)
    targets, shaft = 20.0 * np.sign(np.sin(times)), STILL._replace(viscous=1.0)
    position = simulate_servo(times, targets, np.full(4001, 100.0), 4.0, 0.0, 0.0, shaft)
    signals = {
        "command": targets,
        "position": position,
        "torque": np.clip(4.0 * (targets - position), -100.0, 100.0),
    }
    model = types.SimpleNamespace(
        driven_by="torque", output="position", shaft_parameters=lambda _: shaft
    )
    logs = (
        Log("plain", times, signals),
        Log("of a bus", times, signals | {"bus": np.full(4001, 12.0)}),
    )
    errors = [closed_loop_error(types.SimpleNamespace(model=model, values=()), log) for log in logs]
    assert errors[0] == errors[1]
    assert errors[0] < 0.01
