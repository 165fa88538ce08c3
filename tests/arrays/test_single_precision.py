"""Arrays of 32-bit floats, and JAX without 64-bit integers."""

import numpy as np
import pytest

from codrl_mj.actuators import noise
from codrl_mj.arrays import UnsupportedError, array_code
from codrl_mj.arrays.array_code import ArrayCode
from codrl_mj.arrays.reader import Reader
from codrl_mj.arrays.scalars import Scalar
from tests.arrays.cases import case, errors_of, python_results
from tests.arrays.runs import rounded, run_arrays


def to_float32(column):
    return column.astype(np.float32)


def torque_errors(actuators, results):
    """Return the errors of the torque, after a check that all flags are equal."""
    relative = errors_of(actuators, python_results(actuators), results)
    assert np.isfinite(relative).all()
    return relative[:, actuators.state.shape[1]]


@pytest.mark.parametrize(
    "name", ["current_loop", "drive", "servo", "pwm_servo", "lag", "torque_speed"]
)
def test_numpy_in_float32_is_close_to_python(name):
    actuators = rounded(case(name, 200))
    results = run_arrays(actuators, np, to_float32)
    assert results.dtype == np.float32
    assert 1e-9 < torque_errors(actuators, results).max() < 3e-5


@pytest.mark.parametrize("name", ["current_loop", "drive"])
def test_torch_in_float32_is_close_to_python(name):
    torch = pytest.importorskip("torch", reason="NOT RUN: torch is not installed")
    actuators = rounded(case(name, 100))
    results = run_arrays(actuators, torch, lambda x: torch.tensor(to_float32(x)))
    assert results.dtype == np.float32
    assert torque_errors(actuators, results).max() < 3e-5


@pytest.fixture
def narrow_jax():
    """Return JAX without 64-bit types."""
    jax = pytest.importorskip("jax", reason="NOT RUN: JAX is not installed: pip install jax")
    with jax.enable_x64(False):
        yield jax


def read(jax, function, *columns):
    """Return the result of a function of arrays in JAX without 64-bit types."""
    arrays = [jax.numpy.asarray(to_float32(column)) for column in columns]
    reader = Reader(ArrayCode(jax.numpy, arrays[0], arrays[0].shape))
    return reader.read(function, tuple(Scalar("float", array) for array in arrays)).operand


def draw_normal(key, step, substep):
    return noise.standard_normal(key, int(step), index=int(substep))


def test_noise_without_64_bit_integers_has_the_same_numbers(narrow_jax):
    rng, num = np.random.default_rng(0), 100_000
    small, large = rng.integers(0, 2**24, num), rng.integers(0, 2**24, num) * 2**29
    keys = np.where(rng.random(num) < 0.5, small, large).astype(float)
    steps, substeps = rng.integers(0, 2**22, num), rng.integers(0, 50, num)
    results = np.asarray(read(narrow_jax, draw_normal, keys, steps, substeps))
    rows = zip(keys.tolist(), steps.tolist(), substeps.tolist(), strict=True)
    values = np.array([noise.standard_normal(*row) for row in rows])
    assert results.dtype == np.float32
    assert np.quantile(np.abs(results - values), 0.999) < 5e-6
    assert np.abs(results - values).max() < 1e-3


def low_word(x):
    return (int(x) * 3) & 0xFFFFFFFF


def test_an_integer_of_64_bits_is_refused_with_its_line(narrow_jax):
    line = low_word.__code__.co_firstlineno + 1
    message = f"py:{line}, in low_word: the int 4294967295 needs 64 bits, which JAX lacks: jax.co"
    with pytest.raises(UnsupportedError, match=message):
        read(narrow_jax, low_word, np.ones(2))


def test_arrays_of_float64_are_refused_without_64_bits(narrow_jax):
    with pytest.raises(ValueError, match="has the dtype float64, which JAX lacks: convert it to"):
        run_arrays(case("lag", 200), narrow_jax.numpy)


def test_jax_has_64_bits_if_enabled(narrow_jax):
    assert array_code.has_32_bits(narrow_jax.numpy)
    with narrow_jax.enable_x64(True):
        assert not array_code.has_32_bits(narrow_jax.numpy)
    assert not array_code.has_32_bits(np)
