"""Kernels of Warp compute what a family's plain Python computes, and compile for CUDA devices."""

import numpy as np
import pytest

from codrl_mj.actuators import (
    DCMotorActuator,
    Drive,
    Lag,
    TorqueSpeed,
    parameter_paths,
    parameters_type,
)
from codrl_mj.actuators.servo_friction import has_servo_friction
from tests.arrays.cases import (
    FAMILIES,
    case,
    errors,
    errors_of,
    for_single_precision,
    python_results,
)
from tests.arrays.models import CATALOGUE_MOTOR

wp = pytest.importorskip("warp", reason="NOT RUN: Warp is not installed: make simulators")
# The modules import Warp.
from codrl_mj.arrays import warp as our_warp  # noqa: E402
from codrl_mj.arrays import warp_inertia  # noqa: E402
from codrl_mj.arrays.c_code import replacement_functions  # noqa: E402
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
        varying=tuple(parameter_paths(family).values()),
        per_world=True,
        device="cpu",
        real=real,
        edge=real,
    )

    def column(values):
        return wp.array(values.reshape(num, 1), dtype=kernel._scalar, device="cpu")

    desired, position, speed, time, keys, inertia = actuators.inputs.T.copy()
    for index, values in enumerate(actuators.parameters.T):
        kernel._parameters.entry(index).assign(values.reshape(num, 1))
    num_states = len(family.State._fields)
    for index, values in enumerate(actuators.state.T):
        kernel._states.entry(index).assign(values.reshape(num, 1))
    kernel._keys.assign(keys.reshape(num, 1))
    kernel._record.entry(our_warp.TIME).assign(time.reshape(num, 1))
    steps = np.round(time / actuators.timestep)
    kernel._record.entry(our_warp.STEPS).assign(steps.reshape(num, 1))
    force = column(np.zeros(num))
    times = wp.array(time, dtype=kernel._scalar, device="cpu")
    kernel.step(
        StepArrays(times, column(desired), column(position), column(speed), force, column(inertia))
    )
    states = [kernel._states.entry(num_states + k).numpy()[:, 0] for k in range(num_states)]
    signals = [kernel.signal(name).numpy()[:, 0] for name in family.Signals._fields]
    return np.column_stack([*states, force.numpy()[:, 0], *signals]).astype(float)


@pytest.mark.parametrize("name", FAMILIES)
def test_random_actuators_in_double_equal_python(name):
    assert errors(name, NUM, run(case(name, NUM), "double")).max() < 1e-11


@pytest.mark.parametrize("name", FAMILIES)
def test_torques_of_random_actuators_in_float_are_accurate(name):
    actuators = for_single_precision(case(name, NUM))
    error = errors_of(actuators, python_results(actuators), run(actuators, "float"))
    torque = len(actuators.family.State._fields)
    columns = parameters_type(actuators.family)(*actuators.parameters.T)
    has_friction = np.zeros(len(error), dtype=bool)
    if hasattr(columns, "friction_base"):
        has_friction = has_servo_friction(columns)
    p999 = np.quantile(error[~has_friction, torque], 0.999)
    fields = [*actuators.family.State._fields, "torque", *actuators.family.Signals._fields]
    flags = [index for index, field in enumerate(fields) if field.endswith("saturated")]
    flips = np.isinf(error[:, flags]).sum()
    print(
        f"{name} in float: torque p99.9 {p999:.1e}, max {error[:, torque].max():.1e}, {flips} flags"
    )
    # A servo's command is a difference of positions of up to 300 rad, which a 32-bit float rounds.
    assert p999 < (5e-5 if name == "servo" else 3e-5)
    # The load in the friction of servos is a small difference of large accelerations.
    if has_friction.any():
        p999 = np.quantile(error[has_friction, torque], 0.999)
        print(f"{name} with friction of servos: torque p99.9 {p999:.1e}")
        assert p999 < 1e-3
    assert flips == 0


def test_constants_of_a_kernel_change_nothing():
    drive = CATALOGUE_MOTOR
    forces = []
    for varying in ((), tuple(parameter_paths(type(drive)).values())):
        kernel = WarpActuators([drive] * 3, 2, 0.002, varying=varying, device="cpu", edge="double")
        time, command, position, force = simulator_arrays(2, 3)
        rows = []
        for step in range(20):
            time.fill_(0.002 * step)
            command.fill_(0.5 * (-1) ** (step // 7))
            kernel.step(StepArrays(time, command, position, position, force))
            rows.append(force.numpy().copy())
        forces.append(rows)
    np.testing.assert_allclose(*forces, rtol=1e-12)
    assert np.ptp(forces[0]) > 0.1


def simulator_arrays(num_worlds, num_columns):
    """Return times, and three arrays of zeros, in double."""
    arrays = [wp.zeros((num_worlds, num_columns), dtype=wp.float64, device="cpu") for _ in "abc"]
    return wp.zeros(num_worlds, dtype=wp.float64, device="cpu"), *arrays


def test_each_world_has_its_own_noise():
    noisy = DCMotorActuator().replaced({"controller.current_noise": 0.1})
    kernel = WarpActuators([noisy], 3, 0.002, device="cpu", edge="double")
    kernel.set_noise_keys(np.array([[1], [2], [1]]))
    time, command, position, force = simulator_arrays(3, 1)
    command.fill_(1.0)
    kernel.step(StepArrays(time, command, position, position, force))
    first, second, third = force.numpy()[:, 0]
    assert first == third != second
    with pytest.raises(ValueError, match="must be whole numbers from 0 to 9007199254740991"):
        kernel.set_noise_keys(np.array([[1.5], [2], [1]]))


def test_wrong_arguments_are_refused():
    with pytest.raises(ValueError, match="must be of one family, but are Lag, TorqueSpeed"):
        WarpActuators([Lag(), TorqueSpeed()], 1, 0.002, device="cpu")
    with pytest.raises(
        ValueError, match=r"unknown parameter time_constnt; did you mean time_constant"
    ):
        WarpActuators([Lag()], 1, 0.002, varying=["time_constnt"], device="cpu")
    with pytest.raises(ValueError, match="unknown signal heat"):
        WarpActuators([Drive()], 1, 0.002, device="cpu").signal("heat")


LACKING = {"expm1": np.expm1, "log1p": np.log1p, "hypot": np.hypot, "copysign": np.copysign}


@pytest.mark.parametrize("real", ["double", "float"])
@pytest.mark.parametrize("name", LACKING)
def test_functions_that_warp_lacks_on_a_cpu(name, real):
    scalar, dtype = (wp.float64, np.float64) if real == "double" else (wp.float32, np.float32)
    arguments = "x, y" if name in ("hypot", "copysign") else "x"
    call = f"return {name}{'f' if real == 'float' else ''}({arguments});"
    functions = replacement_functions(real, [call])
    assert replacement_functions(real, ["return 1.0;"]) == []

    @wp.func_native("\n".join([*functions, call]))
    def native(x: scalar, y: scalar) -> scalar: ...

    @wp.kernel(enable_backward=False, module="unique")
    def run(a: wp.array(dtype=scalar), b: wp.array(dtype=scalar), out: wp.array(dtype=scalar)):
        out[wp.tid()] = native(a[wp.tid()], b[wp.tid()])

    x = np.concatenate([np.geomspace(1e-12, 20.0, 200), [0.0, 0.5]]).astype(dtype)
    x = np.concatenate([x, -np.minimum(x, 0.9)])
    y = np.resize(np.array([1.0, -0.3, 0.0, -0.0], dtype), x.size)
    a, b, out = (wp.array(values, dtype=scalar, device="cpu") for values in (x, y, 0.0 * x))
    wp.launch(run, x.size, inputs=[a, b], outputs=[out], device="cpu")
    expected = LACKING[name](x, y) if "," in arguments else LACKING[name](x)
    np.testing.assert_allclose(out.numpy(), expected, rtol=8 * np.finfo(dtype).eps)


@pytest.mark.parametrize("architecture", [80, 90])
@pytest.mark.parametrize("real", ["double", "float"])
@pytest.mark.parametrize("name", ["drive", "servo", "current_loop", "gearbox"])
def test_kernels_compile_for_cuda_without_a_device(name, real, architecture, tmp_path):
    family = FAMILIES[name][0]
    kernel = our_warp._kernel(family(), parameter_paths(family), 0.002, real, "float")
    compile_for_cuda(kernel, architecture, tmp_path)


def test_the_kernels_of_the_inertia_compile_for_cuda(tmp_path):
    compile_for_cuda(warp_inertia._factorize, 90, tmp_path)


def compile_for_cuda(kernel, architecture, folder):
    wp.compile_aot_module(kernel.module, arch=[architecture], module_dir=folder, use_ptx=True)
    (path,) = folder.glob("*.ptx")
    assert f".target sm_{architecture}" in path.read_text()
