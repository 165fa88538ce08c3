"""Runs of random actuators through the back ends."""

import ctypes
import shutil
import subprocess

import numpy as np

from codrl_mj.arrays import advance, c_function

COMPILER = shutil.which("gcc") or shutil.which("clang")
STRICT = ("-std=c99", "-O2", "-ffp-contract=off", "-Wall", "-Wextra", "-Wpedantic", "-Werror")
UNUSED = ("-Wno-unused-variable", "-Wno-unused-parameter", "-Wno-unused-but-set-variable")
DRIVER = """
void run(long num, double timestep, const struct advance_actuator_parameters *p,
         const struct advance_actuator_state *s, const struct advance_actuator_inputs *x,
         struct advance_actuator_state *after, double *torque, struct advance_actuator_signals *signals) {
    for (long k = 0; k < num; k++)
        torque[k] = advance_actuator(p + k, timestep, s + k, x + k, after + k, signals + k);
}
"""


def compile_c(text, folder):
    """Return the function `run` of a C file, compiled with all warnings as errors."""
    source, library = folder / "advance.c", folder / "advance.so"
    source.write_text(text)
    options = (*STRICT, *UNUSED, "-shared", "-fPIC")
    subprocess.run([COMPILER, *options, "-o", library, source, "-lm"], check=True)
    return ctypes.CDLL(str(library)).run


def run_c(actuators, folder, portable=False):
    """Return states, torques and signals by compiled C, shape (n, s + 1 + k)."""
    run = compile_c(c_function(actuators.family, portable=portable) + DRIVER, folder)
    num = len(actuators.inputs)

    def rows(values):
        # An empty struct has one unused double.
        return np.ascontiguousarray(values) if values.shape[1] else np.zeros((num, 1))

    widths = len(actuators.family.State._fields), len(actuators.family.Signals._fields)
    after, signals = (np.zeros((num, max(width, 1))) for width in widths)
    torque = np.zeros(num)
    pointer = np.ctypeslib.ndpointer(np.float64, flags="C")
    run.argtypes = [ctypes.c_long, ctypes.c_double, *[pointer] * 6]
    run.restype = None
    inputs = (actuators.parameters, actuators.state, actuators.inputs)
    run(num, actuators.timestep, *map(rows, inputs), after, torque, signals)
    return np.column_stack([after[:, : widths[0]], torque, signals[:, : widths[1]]])


def rounded(actuators):
    """Return actuators whose parameters, states and inputs are numbers of float32."""
    tables = (actuators.parameters, actuators.state, actuators.inputs)
    p, s, x = (values.astype(np.float32).astype(float) for values in tables)
    return actuators._replace(parameters=p, state=s, inputs=x)


def run_arrays(actuators, module, convert=np.array, wrap=lambda function: function):
    """Return states, torques and signals by arrays, shape (n, s + 1 + k)."""
    parameters, timestep, state, inputs = actuators.arguments(convert)
    step = wrap(lambda p, s, x: advance(actuators.family, module, p, timestep, s, x))
    after, torque, signals = step(parameters, state, inputs)
    return np.column_stack([np.asarray(column) for column in (*after, torque, *signals)])
