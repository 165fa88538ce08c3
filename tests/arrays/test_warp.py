"""The statements of `c_program` run in kernels of Warp, on a CPU."""

import linecache

import numpy as np
import pytest

from codrl_mj.actuators import Inputs, parameters_type
from codrl_mj.arrays import c_program
from tests.arrays.cases import FAMILIES, case, errors

warp = pytest.importorskip("warp", reason="NOT RUN: Warp is not installed: pip install warp-lang")
KERNEL = """
@warp.func_native(snippet)
def native(row: int, timestep: warp.float64, p: A, s: A, x: A, out: A):
    ...

@warp.kernel(enable_backward=False, module="unique")
def step(timestep: warp.float64, p: A, s: A, x: A, out: A):
    native(warp.tid(), timestep, p, s, x, out)
"""


def snippet_of(family):
    """Return statements that read a row of each table and write a row of results."""
    program = c_program(family, portable=True)
    tables = {"p": parameters_type(family)._fields, "s": family.State._fields, "x": Inputs._fields}
    loads = [
        f"const double {letter}_{name} = {letter}.data[row * {len(names)} + {column}];"
        for letter, names in tables.items()
        for column, name in enumerate(names)
    ]
    values = [*program.state, program.torque, *program.signals]
    stores = [
        f"out.data[row * {len(values)} + {column}] = {value};"
        for column, value in enumerate(values)
    ]
    return "\n".join([*loads, *program.statements, *stores])


@pytest.mark.parametrize("name", FAMILIES)
def test_a_kernel_equals_python(name):
    actuators = case(name, 200)
    # Warp reads the source of a kernel.
    file = f"<kernel of {name}>"
    linecache.cache[file] = (len(KERNEL), None, KERNEL.splitlines(True), file)
    names = {"warp": warp, "A": warp.array(dtype=warp.float64), "__name__": __name__}
    names["snippet"] = snippet_of(actuators.family)
    exec(compile(KERNEL, file, "exec"), names)
    tables = [
        warp.array(np.append(table.ravel(), 0.0), dtype=warp.float64, device="cpu")
        for table in (actuators.parameters, actuators.state, actuators.inputs)
    ]
    out = warp.zeros(actuators.scales.size, dtype=warp.float64, device="cpu")
    inputs = [actuators.timestep, *tables, out]
    warp.launch(names["step"], len(actuators.inputs), inputs=inputs, device="cpu")
    assert errors(name, 200, out.numpy().reshape(actuators.scales.shape)).max() < 1e-11
