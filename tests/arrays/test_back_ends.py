"""Back ends compute what a family's plain Python computes, for random actuators of each family."""

import numpy as np
import pytest

from codrl_mj.actuators import BUILT_IN
from tests.arrays.cases import FAMILIES, case, errors, expected
from tests.arrays.runs import COMPILER, run_arrays, run_c
from tests.matrix import matrix_params

TOLERANCE = 1e-11
EVERY = matrix_params(
    [(name, 200) for name in FAMILIES],
    [(name, num) for num in (200, 10_000) for name in FAMILIES],
)
# torch starts each operation slowly, and a noisy current loop and a servo have thousands of them.
EVERY_IN_TORCH = matrix_params(
    [(name, 200) for name in ("drive", "lag", "torque_speed", "gearbox")],
    [(name, num) for num in (200, 10_000) for name in FAMILIES],
)
needs_compiler = pytest.mark.skipif(
    COMPILER is None, reason="NOT RUN: no C compiler: apt-get install gcc"
)


def test_every_built_in_family_has_cases():
    assert {family for family, _ in FAMILIES.values()} >= set(BUILT_IN)


@pytest.mark.parametrize("name", ["drive", "servo", "pwm_servo", "current_loop", "torque_speed"])
def test_cases_are_saturated_and_unsaturated(name):
    actuators = case(name, 200)
    flags = [k for k, field in enumerate(actuators.family.Signals._fields) if "saturated" in field]
    values = expected(name, 200)[:, actuators.state.shape[1] + 1 :]
    for flag in flags:
        assert 0.01 < values[:, flag].mean() < 0.99


@needs_compiler
@pytest.mark.parametrize(("name", "num"), EVERY)
def test_c_equals_python_bit_for_bit(name, num, tmp_path):
    assert errors(name, num, run_c(case(name, num), tmp_path)).max() == 0.0


@needs_compiler
@pytest.mark.parametrize(("name", "num"), EVERY)
def test_portable_c_equals_python(name, num, tmp_path):
    assert errors(name, num, run_c(case(name, num), tmp_path, portable=True)).max() < TOLERANCE


@pytest.mark.parametrize(("name", "num"), EVERY)
def test_numpy_equals_python(name, num):
    assert errors(name, num, run_arrays(case(name, num), np)).max() < TOLERANCE


@pytest.mark.parametrize(("name", "num"), EVERY_IN_TORCH)
def test_torch_equals_python(name, num):
    torch = pytest.importorskip("torch", reason="NOT RUN: torch is not installed")
    results = run_arrays(case(name, num), torch, lambda column: torch.tensor(column.copy()))
    assert errors(name, num, results).max() < TOLERANCE


@pytest.mark.parametrize(("name", "num"), EVERY)
def test_jax_equals_python(name, num):
    jax = pytest.importorskip("jax", reason="NOT RUN: JAX is not installed: pip install jax")
    with jax.enable_x64(True):
        results = run_arrays(case(name, num), jax.numpy, jax.numpy.asarray, jax.jit)
    assert errors(name, num, results).max() < TOLERANCE
