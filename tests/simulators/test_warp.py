"""Kernels of Warp compute what a family's plain Python computes, and compile for CUDA devices."""

import numpy as np
import pytest

from tests.arrays import cases
from tests.arrays.cases import FAMILIES, case, errors, errors_of, python_results

wp = pytest.importorskip("warp", reason="NOT RUN: Warp is not installed: make simulators")
# The module imports Warp.
from codrl_mj.arrays import warp as our_warp  # noqa: E402
from codrl_mj.arrays.warp import StepArrays, WarpActuators  # noqa: E402

wp.config.quiet = True
NUM = 10_000


def run(actuators, real):
    """Return states, torques and signals, shape (n, s + 1 + k); each actuator has a world."""
    family, num = actuators.family, len(actuators.inputs)
    kernel = WarpActuators(
        [family()],
        num,
        actuators.timestep,
        varying=tuple(our_warp.parameter_paths(family).values()),
        per_world=True,
        device="cpu",
        real=real,
        edge=real,
    )

    def column(values):
        return wp.array(values.reshape(num, 1), dtype=kernel._scalar, device="cpu")

    desired, position, speed, time, keys, inertia = actuators.inputs.T.copy()
    if actuators.parameters.size:
        kernel._parameters.assign(actuators.parameters.T.ravel())
    num_states = len(family.State._fields)
    if num_states:
        kernel._states.assign(np.tile(actuators.state.T.ravel(), 2))
    kernel._keys.assign(keys.reshape(num, 1))
    record = np.zeros((our_warp._RECORD_SIZE, num, 1))
    record[our_warp.TIME, :, 0] = time
    record[our_warp.STEPS, :, 0] = np.round(time / actuators.timestep)
    kernel._record.assign(record)
    force = column(np.zeros(num))
    times = wp.array(time, dtype=kernel._scalar, device="cpu")
    kernel.step(
        StepArrays(times, column(desired), column(position), column(speed), force, column(inertia))
    )
    states = kernel._states.numpy()[num_states * num :][: num_states * num].reshape(-1, num)
    signals = [kernel.signal(name).numpy()[:, 0] for name in family.Signals._fields]
    return np.column_stack([*states, force.numpy()[:, 0], *signals]).astype(float)


@pytest.mark.parametrize("name", FAMILIES)
def test_random_actuators_in_double_equal_python(name):
    assert errors(name, NUM, run(case(name, NUM), "double")).max() < 1e-11


@pytest.mark.parametrize("name", FAMILIES)
def test_torques_of_random_actuators_in_float_are_accurate(name):
    actuators = case(name, NUM)
    inputs = actuators.inputs.copy()
    inputs[:, cases.Inputs._fields.index("noise_key")] %= 2**24
    actuators = actuators._replace(inputs=inputs)
    error = errors_of(actuators, python_results(actuators), run(actuators, "float"))
    torque = len(actuators.family.State._fields)
    flags = [
        torque + 1 + index
        for index, name in enumerate(actuators.family.Signals._fields)
        if name.endswith("saturated")
    ]
    print(
        name,
        "float: torque p99.9",
        np.quantile(error[:, torque], 0.999),
        "max",
        error[:, torque].max(),
        "flags that differ",
        np.isinf(error[:, flags]).sum(0),
    )
    assert np.quantile(error[:, torque], 0.999) < 3e-5
