"""The page of numbers: what the bench in the engine measures is what closed forms and datasheets say."""

import csv
import importlib.util
import math
from pathlib import Path

import control
import numpy as np
import pytest

from codrl_mj.catalogue import motor_entry, motor_names
from tests.matrix import but

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"


_SPEC = importlib.util.spec_from_file_location(
    "actuator_numbers", ROOT / "scripts" / "actuator_numbers.py"
)
SCRIPT = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(SCRIPT)


def written(kind):
    with (DOCS / SCRIPT.TABLES[kind]).open(newline="") as file:
        return list(csv.DictReader(file))


def same(row, computed):
    """Whether a row of a CSV file is what is computed: words exactly, numbers to the digits that are written."""
    assert list(row) == list(computed)
    for name, value in computed.items():
        if isinstance(value, float):
            assert float(row[name]) == pytest.approx(value, rel=2e-5, abs=1e-6, nan_ok=True), name
        else:
            assert row[name] == str(value)


# the files


def test_the_page_is_what_the_tables_say_and_they_have_every_name():
    tables = {kind: written(kind) for kind in SCRIPT.TABLES}
    assert (DOCS / SCRIPT.PAGE).read_text() == SCRIPT.page(tables)
    assert [row["motor"] for row in tables["motors"]] == motor_names()
    named = [name for name in SCRIPT.NAMED if name != "ideal"]
    assert [(row["task"], row["actuator"]) for row in tables["tasks"]] == [
        (task, name) for task in SCRIPT.TASKS for name in named
    ]


@pytest.mark.parametrize("index", but([4], range(20)))
def test_the_tasks_table_is_what_is_measured(index):
    row = written("tasks")[index]
    same(row, SCRIPT.task_row(row["task"], row["actuator"]))


# closed forms


def test_the_loop_of_the_cartpole_is_python_control_s():
    """PID and plain Euler winding in z; delivered is the current after the step, so a sample early."""
    row, h, resistance, inductance = written("tasks")[4], 0.02, 1.0, 0.1
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


def test_a_motor_s_row_is_that_of_the_closed_forms():
    """The EC 45 flat, whose loop is P/(z - 1)."""
    row = next(row for row in written("motors") if row["motor"] == "maxon-ec45-flat-50w")
    numbers, rate, share = motor_entry(row["motor"]).parameters, 20e3, -math.expm1(-0.349)
    left, constant, free = 1 - share, numbers.torque_constant, 0.238
    angle = math.acos((1 + left**2 - 2 * share**2) / (2 * left))
    expected = {
        "settled_2_ms": 1e3 * math.ceil(math.log(0.02) / math.log(left)) / rate,
        "bandwidth_hz": angle / math.tau * rate,
        "stall_torque": constant * (24.0 / 0.942 - free),
        "no_load_speed": (24.0 - 0.942 * free) / numbers.back_emf_constant,
        "continuous_torque": constant * (2.52 - free),
        "mechanical_time_constant_ms": (
            1e3 * 0.942 * 135e-7 / (constant * numbers.back_emf_constant)
        ),
    }
    assert {name: float(row[name]) for name in expected} == pytest.approx(expected, rel=1e-3)


# datasheets


@pytest.mark.parametrize("name", motor_names())
def test_every_motor_of_the_catalogue_does_in_the_engine_what_its_datasheet_prints(name):
    """To 5 %; and what follows from its constants, whether that is printed or not."""
    entry, row = motor_entry(name), SCRIPT.motor_row(name)
    same(next(row for row in written("motors") if row["motor"] == name), row)
    numbers, printed = entry.parameters, entry.datasheet.readings()
    ratio, passed = numbers.gear_ratio, (numbers.gear_efficiency or 1.0) * numbers.torque_constant
    coulomb, viscous = numbers.coulomb_friction or 0.0, numbers.viscous_friction or 0.0
    volts, ohms, emf = numbers.voltage or 24.0, numbers.resistance, numbers.back_emf_constant
    measured = {
        "stall_torque": row["stall_torque"],
        "no_load_speed": row["no_load_speed"],
        "mechanical_time_constant": 1e-3 * row["mechanical_time_constant_ms"],
    }
    damping = passed * emf / ohms + viscous
    follows = {
        "stall_torque": ratio * (passed * volts / ohms - coulomb),
        "no_load_speed": (passed * volts / ohms - coulomb) / damping / ratio,
        "mechanical_time_constant": (
            math.nan if numbers.rotor_inertia is None else numbers.rotor_inertia / damping
        ),
    }
    assert measured == pytest.approx(follows, rel=2e-3, nan_ok=True)
    for field in measured.keys() & printed.keys():
        at_motor = printed[field].shaft == "motor" and field != "mechanical_time_constant"
        seen = (
            printed[field].value * (ratio if field == "stall_torque" else 1.0 / ratio) ** at_motor
        )
        assert measured[field] == pytest.approx(seen, rel=0.05), field
