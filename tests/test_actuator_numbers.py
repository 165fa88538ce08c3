"""Page of actuators in numbers: bench results agree with closed forms and datasheets."""

import csv
import importlib.util
import math
from pathlib import Path

import control
import numpy as np
import pytest

from codrl_mj.catalogue import motor_entry, motor_names
from tests.matrix import matrix_params

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"


_SPEC = importlib.util.spec_from_file_location(
    "actuator_numbers", ROOT / "scripts" / "actuator_numbers.py"
)
SCRIPT = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(SCRIPT)


def read_table(kind):
    with (DOCS / SCRIPT.TABLES[kind]).open(newline="") as file:
        return list(csv.DictReader(file))


def check_row(row, computed):
    """Check that a row of a CSV file has the computed words, and numbers to the written digits."""
    assert list(row) == list(computed)
    for name, value in computed.items():
        if isinstance(value, float):
            assert float(row[name]) == pytest.approx(value, rel=2e-5, abs=1e-6, nan_ok=True), name
        else:
            assert row[name] == str(value)


# files


def test_the_page_agrees_with_the_tables_which_have_every_actuator():
    tables = {kind: read_table(kind) for kind in SCRIPT.TABLES}
    assert (DOCS / SCRIPT.PAGE).read_text() == SCRIPT.page(tables)
    assert [row["motor"] for row in tables["motors"]] == motor_names()
    named = [name for name in SCRIPT.NAMED if name != "ideal"]
    assert [(row["task"], row["actuator"]) for row in tables["tasks"]] == [
        (task, name) for task in SCRIPT.TASKS for name in named
    ]


@pytest.mark.parametrize("index", matrix_params([4], range(20)))
def test_the_table_of_tasks_agrees_with_the_bench(index):
    row = read_table("tasks")[index]
    check_row(row, SCRIPT.task_row(row["task"], row["actuator"]))


# closed forms


def test_cartpoles_loop_agrees_with_python_control():
    """The PID and the Euler winding are transfer functions in z.

    The delivered current is the one after the step, so it comes a sample early.
    """
    row, h, resistance, inductance = read_table("tasks")[4], 0.02, 1.0, 0.1
    assert (row["task"], row["actuator"]) == ("cartpole", "paper")
    kp, ki, kd, kff, arm, voltage = 4.3, 1.0, 1e-6, 0.6, 0.15, 24.0
    z = control.TransferFunction([1, 0], [1], h)
    pid = kp + ki * h * z / (z - 1) + kd / h * (z - 1) / z
    winding = (h / inductance) / (z - (1 - h * resistance / inductance))
    closed = control.minreal(z * (pid + kff) * winding / (1 + pid * winding), verbose=False)
    _, shares = control.step_response(closed, np.arange(10_000) * h)
    for band in (5, 2):
        steps = 1 + int(np.flatnonzero(np.abs(shares - 1) > band / 100)[-1])
        assert float(row[f"settled_{band}_steps"]) == pytest.approx(steps)
        assert float(row[f"settled_{band}_s"]) == pytest.approx(steps * h)
    assert float(row["first_step_percent"]) == pytest.approx(100 * shares[0], rel=1e-5)
    assert abs(float(row["steady_error_percent"])) < 1e-6
    assert float(row["stall_torque"]) == pytest.approx(voltage / resistance / arm)  # kT = 1
    assert float(row["no_load_speed"]) == pytest.approx(voltage * arm)  # kE = 1


def test_a_motors_row_agrees_with_closed_forms():
    """The loop of the EC 45 flat is P/(z - 1)."""
    row = next(row for row in read_table("motors") if row["motor"] == "maxon-ec45-flat-50w")
    numbers, rate, gain = motor_entry(row["motor"]).parameters, 20e3, -math.expm1(-0.349)
    pole, constant, friction_current = 1 - gain, numbers.torque_constant, 0.238
    angle = math.acos((1 + pole**2 - 2 * gain**2) / (2 * pole))
    expected = {
        "settled_2_ms": 1e3 * math.ceil(math.log(0.02) / math.log(pole)) / rate,
        "bandwidth_hz": angle / math.tau * rate,
        "stall_torque": constant * (24.0 / 0.942 - friction_current),
        "no_load_speed": (24.0 - 0.942 * friction_current) / numbers.back_emf_constant,
        "continuous_torque": constant * (2.52 - friction_current),
        "mechanical_time_constant_ms": (
            1e3 * 0.942 * 135e-7 / (constant * numbers.back_emf_constant)
        ),
    }
    assert {name: float(row[name]) for name in expected} == pytest.approx(expected, rel=1e-3)


# datasheets


@pytest.mark.parametrize("name", motor_names())
def test_every_motor_of_the_catalogue_agrees_with_its_datasheet_in_the_engine(name):
    """The datasheet's values hold to 5 %, values from its constants to 0.2 %.

    A datasheet that contradicts itself by more is simulated with one of the two values.
    """
    entry, row = motor_entry(name), SCRIPT.motor_row(name)
    check_row(next(row for row in read_table("motors") if row["motor"] == name), row)
    numbers, printed = entry.parameters, entry.datasheet.parsed_values()
    ratio, torque_per_current = (
        numbers.gear_ratio,
        (numbers.gear_efficiency or 1.0) * numbers.torque_constant,
    )
    coulomb, viscous = numbers.coulomb_friction or 0.0, numbers.viscous_friction or 0.0
    volts, ohms, emf = numbers.voltage or 24.0, numbers.resistance, numbers.back_emf_constant
    measured = {
        "stall_torque": row["stall_torque"],
        "no_load_speed": row["no_load_speed"],
        "mechanical_time_constant": 1e-3 * row["mechanical_time_constant_ms"],
    }
    damping = torque_per_current * emf / ohms + viscous
    expected = {
        "stall_torque": ratio * (torque_per_current * volts / ohms - coulomb),
        "no_load_speed": (torque_per_current * volts / ohms - coulomb) / damping / ratio,
        "mechanical_time_constant": (
            math.nan if numbers.rotor_inertia is None else numbers.rotor_inertia / damping
        ),
    }
    # At first, static friction holds the rotor for a fraction of a 50 us sample.
    assert measured == pytest.approx(expected, rel=2e-3, abs=1e-5, nan_ok=True)
    for field in measured.keys() & printed.keys():
        at_motor = printed[field].shaft == "motor" and field != "mechanical_time_constant"
        at_output = (
            printed[field].value * (ratio if field == "stall_torque" else 1.0 / ratio) ** at_motor
        )
        accuracy = max([0.05, *(2e-3 + abs(d.difference) for d in numbers.disagreements)])
        assert measured[field] == pytest.approx(at_output, rel=accuracy), field
