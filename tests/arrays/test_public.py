"""Public functions: light imports, arguments that are refused, and the text of C."""

import ctypes
import math
import re
import subprocess
import sys

import numpy as np
import pytest

from codrl_mj import arrays
from codrl_mj.actuators import DCMotorActuator, Drive, Inputs, Lag, TorqueSpeed, parameters_type
from codrl_mj.arrays import advance, c_function, c_program
from tests.arrays.runs import COMPILER, UNUSED, compile_c

PROGRAM = """
import sys
import codrl_mj.actuators
before = set(sys.modules)
import codrl_mj.arrays
from codrl_mj.arrays import advance, c_function, check_family
heavy = {"numba", "torch", "jax", "warp", "scipy"} & set(sys.modules)
print(sorted(heavy), sorted(m for m in set(sys.modules) - before if not m.startswith("codrl_mj")))
"""


def test_the_package_imports_nothing_besides_the_standard_library():
    output = subprocess.run(
        [sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True
    ).stdout
    heavy, others = re.fullmatch(r"(\[.*?\]) (\[.*?\])\n", output).groups()
    assert heavy == "[]"
    assert {name.split(".")[0] for name in re.findall(r"'(.*?)'", others)} <= set(
        sys.stdlib_module_names
    )


def test_public_names_exist():
    for name in arrays.__all__:
        assert getattr(arrays, name).__name__ == name
    with pytest.raises(AttributeError, match="no attribute 'unknown'"):
        _ = arrays.unknown


def line_inputs(speed):
    return Inputs(1.0, 0.0, speed, 0.0, 0.0)


def test_floats_stand_for_all_actuators_and_arrays_are_broadcast():
    speed, torques = np.linspace(0.0, 5.0, 3), np.array([[1.0], [2.0]])
    _, torque, signals = advance(
        TorqueSpeed, np, (torques, 10.0, math.inf), 0.01, (), line_inputs(speed)
    )
    np.testing.assert_allclose(torque, np.minimum(torques * (1.0 - speed / 10.0), 1.0))
    assert signals.saturated.shape == torque.shape == (2, 3)


def test_parameters_may_be_a_mapping():
    parameters = {"stall_torque": 1.0, "no_load_speed": 10.0, "max_torque": 0.5}
    _, torque, _ = advance(TorqueSpeed, np, parameters, 0.01, (), line_inputs(np.zeros(2)))
    assert torque.tolist() == [0.5, 0.5]


def test_results_without_dependence_on_arrays_have_the_common_shape():
    parameters = parameters_type(Lag)(0.05, 0.0, 1.0)
    state, torque, _ = advance(
        Lag, np, parameters, 0.01, [0.0] * 9, Inputs(1.0, np.zeros(4), 0.0, 0.0, 0.0)
    )
    assert torque.shape == state.c1.shape == (4,)


def test_arrays_of_integers_are_refused():
    message = "speed has the dtype int64: expected float64 or float32; convert it"
    with pytest.raises(ValueError, match=message):
        advance(TorqueSpeed, np, (1.0, 10.0, 1.0), 0.01, (), line_inputs(np.zeros(2, np.int64)))


def test_arrays_of_two_types_are_refused():
    message = "speed has the dtype float32, and stall_torque has float64: expected the same for all"
    with pytest.raises(ValueError, match=message):
        advance(
            TorqueSpeed,
            np,
            (np.ones(2), 10.0, 1.0),
            0.01,
            (),
            line_inputs(np.zeros(2, np.float32)),
        )


@pytest.mark.parametrize(
    ("number", "message"),
    [(0, "max_iterations = 0: must be >= 1"), (3, "= 3: is for jax.numpy only; leave it None for")],
)
def test_a_limit_of_iterations_is_for_jax(number, message):
    with pytest.raises(ValueError, match=message):
        advance(TorqueSpeed, np, (1.0, 10.0, 1.0), 0.01, (), line_inputs(np.zeros(2)), number)


def test_inputs_without_arrays_are_refused():
    with pytest.raises(ValueError, match="no entry is an array: expected at least one"):
        advance(TorqueSpeed, np, (1.0, 10.0, 1.0), 0.01, (), line_inputs(0.0))


def test_a_name_that_c_does_not_allow_is_refused():
    with pytest.raises(ValueError, match="name = 'my motor': expected letters, digits and _"):
        c_function(TorqueSpeed(), name="my motor")


def test_the_text_of_an_actuator_has_its_values_and_its_arm():
    text = c_function(TorqueSpeed(stall_torque=2.5, no_load_speed=30.0), name="line")
    assert "double line(" in text
    assert "const double v1 = x_speed / 30.0;" in text
    assert "2.5" in text
    assert "parameters" not in text
    assert "with arm = 0.05. */" in c_function(Drive().replaced({"motor.gear_ratio": 20.0}))


def test_a_program_of_floats_computes_with_floats_only():
    for family in (Drive, DCMotorActuator, Lag):
        text = "\n".join(c_program(family, portable=True, real="float").statements)
        assert "double" not in text
        assert "const float v" in text
        assert not re.findall(r"(?<![\w.])\d+\.\d+(?:e[-+]?\d+)?(?![\w.])", text)
        assert not re.findall(r"\b(?:exp|log|sqrt|fabs|fmod|cos)\(", text)
    with pytest.raises(ValueError, match="real = 'half': must be 'double' or 'float'"):
        c_program(Lag, real="half")


def test_some_parameters_of_an_actuator_may_stay_variables():
    lag = Lag(time_constant=0.123, gain=0.75)
    text = "\n".join(c_program(lag, variables=["gain"]).statements)
    assert "p_gain" in text
    assert "0.123" in text
    assert "p_time_constant" not in text


@pytest.mark.skipif(COMPILER is None, reason="NOT RUN: no C compiler: apt-get install gcc")
def test_an_actuator_in_c_equals_its_family_in_c(tmp_path):
    drive = Drive()
    first, second = c_function(drive, "first"), c_function(Drive, "second")
    values = ", ".join(map(repr, drive.parameter_values)).replace("inf", "HUGE_VAL")
    calls = f"""
double run(double torque, double speed) {{
    struct second_parameters p = {{{values}}};
    struct first_state a = {{0}};
    struct first_inputs x = {{torque, 0.0, speed, 0.002, 0.0, 1e-5}};
    struct first_signals signals;
    struct second_state b = {{0}};
    struct second_inputs y = {{torque, 0.0, speed, 0.002, 0.0, 1e-5}};
    struct second_signals others;
    double difference = 0.0;
    for (int k = 0; k < 5; k++)
        difference += fabs(first(0.002, &a, &x, &a, &signals) - second(&p, 0.002, &b, &y, &b, &others));
    return difference + fabs(a.current - b.current);
}}
"""
    run = compile_c(first + second + calls, tmp_path)
    run.restype, run.argtypes = ctypes.c_double, [ctypes.c_double, ctypes.c_double]
    assert run(0.02, 30.0) == run(1.0, -500.0) == 0.0


@pytest.mark.skipif(COMPILER is None, reason="NOT RUN: no C compiler: apt-get install gcc")
@pytest.mark.parametrize("portable", [False, True])
def test_the_text_is_also_c_plus_plus(portable, tmp_path):
    source = tmp_path / "drive.cpp"
    source.write_text(c_function(Drive, portable=portable))
    command = [COMPILER, "-x", "c++", "-std=c++17", "-Wall", "-Werror", *UNUSED]
    subprocess.run([*command, "-fsyntax-only", source], check=True)
