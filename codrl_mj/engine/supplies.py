"""Shared supplies: the drives of a supply advance together, sample by sample.

`codrl_mj.actuators.shared_drive` has the equations. Both backends pass the drives of a supply as
rows of memory with the layout of `Row`; `load_supplies` returns the compiled function that advances
them. It takes a second to compile, so it is called through its address, and compiled only for
models with a shared supply.
"""

import functools
import math
from types import FunctionType
from typing import NamedTuple, cast

import numpy as np
from numba import types

from codrl_mj.actuators import SharedDrive, SharedVoltageDrive, family_id
from codrl_mj.actuators import shared_drive as equations
from codrl_mj.actuators.drive import State
from codrl_mj.actuators.model import Inputs
from codrl_mj.actuators.parameters import parameters_type
from codrl_mj.actuators.shaft import StepAverages
from codrl_mj.compile_cache import CompiledCallback, cfunc
from codrl_mj.engine.memory import (
    Pointer,
    call,
    entry_address,
    f64,
    internal,
    named_address,
    read,
    register_callees,
    stack_floats,
    u64,
    write,
)


class Row(NamedTuple):
    """Drive of a supply in a mechanical step: eight bytes each, float64 or an address (uint64)."""

    closed: float
    """1 if a current loop is closed around the winding, else 0."""
    parameters: float
    """Address of the parameters."""
    state: float
    """Address of the committed state; the candidate state and the signals follow it."""
    torque: float
    """Address of the delivered torque."""
    desired_torque: float
    position: float
    speed: float
    time: float
    key: float
    inertia: float


ROW_SIZE = len(Row._fields)
"""Number of float64 in a row."""

_PARAMETERS = parameters_type(SharedDrive)
_NUMBER = _PARAMETERS._fields.index("supply_number")
_CLOSED, _OPEN = family_id(SharedDrive), family_id(SharedVoltageDrive)
_NUM_STATES = len(State._fields)

_PARTS = (equations.StepConstants, equations.Piece, equations.Sampled, StepAverages)
_OFFSETS = tuple(8 * sum(len(part._fields) for part in _PARTS[:n]) for n in range(len(_PARTS)))
_COMMAND = sum(len(part._fields) for part in _PARTS)
"""Offset of a drive's commanded voltage in its work array, after its parts."""
REQUESTED, CURRENT, _IS_FREE = _COMMAND + 1, _COMMAND + 2, _COMMAND + 3
"""Offsets of the requested voltage, the current, and 1 while the drive counts as not saturated."""
WORK_SIZE = _COMMAND + 4
"""Number of float64 in the work array of a drive."""

_FUNCTION_ADDRESS = np.zeros(1, dtype=np.uintp)
_function_pointer = named_address("codrl_mj_supplies", _FUNCTION_ADDRESS.ctypes.data)


@internal(inline="always")
def shares_supply(family_number: int) -> bool:
    """Return True if actuators of a family share a supply."""
    return family_number in (_CLOSED, _OPEN)


@internal(inline="always")
def supply_number(parameters: int) -> float:
    """Return the number of the supply of a drive, from the address of its parameters."""
    return f64(parameters)[_NUMBER]


@internal
def write_row(
    row: int,
    family_number: int,
    parameters: int,
    slot: int,
    state: int,
    desired: float,
    position: float,
    speed: float,
    time: float,
    inertia: float,
) -> None:
    """Write a drive's `Row` to an address.

    `state` is the address of the committed state in the slot; the other values are those of
    `advance_slot`.
    """
    values, addresses, header = f64(row), u64(row), f64(slot)
    values[0] = 1.0 if family_number == _CLOSED else 0.0
    addresses[1], addresses[2], addresses[3] = parameters, state, slot + 16
    values[4], values[5], values[6] = desired, position, speed
    values[7], values[8], values[9] = time, header[1], inertia


@internal
def advance_supply(rows: int, count: int, timestep: float) -> float:
    """Advance the drives of a supply by a mechanical step [s]; `rows` is an address."""
    return call(u64(_function_pointer())[0], rows, count, timestep)


@internal
def bus_voltage(
    work: Pointer[float] | np.ndarray,
    size: int,
    count: int,
    source: float,
    resistance: float,
    recharges: bool,
) -> float:
    """Return the voltage [V] of a supply at a sample, from requested voltages and currents.

    The largest solution of the equation in `shared_drive` is found from above: the drives count
    as saturated one by one, in the order of the voltages that they want. With the current S of the
    saturated drives and the power P of the others, V^2 - (E - Rs*S)*V + Rs*P = 0.

    Args:
        work: array with the entries `REQUESTED`, `CURRENT` and `_IS_FREE` for each drive.
        size: number of entries per drive.
        count: number of drives.
        source: voltage [V] of the source.
        resistance: its resistance [ohm].
        recharges: True if the source takes current.
    """
    if resistance == 0.0:
        return source
    for motor in range(count):
        work[size * motor + _IS_FREE] = 1.0
    saturated, above, voltage = 0.0, math.inf, 0.0
    # Each pass takes another drive as saturated. The last pass has a solution for sure.
    for _ in range(count + 1):
        power, below, largest = 0.0, 0.0, -1
        for motor in range(count):
            requested = work[size * motor + REQUESTED]
            if work[size * motor + _IS_FREE] == 0.0:
                continue
            drawn = work[size * motor + CURRENT]
            power += abs(requested) * (drawn if requested > 0.0 else -drawn)
            if largest < 0 or abs(requested) > below:
                below, largest = abs(requested), motor
        available = source - resistance * saturated
        square = available * available - 4.0 * resistance * power
        voltage = 0.5 * (available + math.sqrt(max(square, 0.0)))
        if largest < 0 or (square >= 0.0 and voltage >= below):
            break
        requested, drawn = work[size * largest + REQUESTED], work[size * largest + CURRENT]
        saturated += drawn if requested > 0.0 else -drawn
        work[size * largest + _IS_FREE], above = 0.0, below
    voltage = min(max(voltage, 0.0), above)
    return voltage if recharges else min(voltage, source)


@functools.cache
def load_supplies() -> CompiledCallback[[int, int, float], float]:
    """Compile the function behind `advance_supply`, once per process, and return it.

    The supply is that of the first drive, whose sample rate also holds for all.
    """
    for function in (
        equations.begin_step,
        equations.request_voltage,
        equations.advance_sample,
        equations.end_step,
        equations.source_current,
    ):
        register_callees(cast(FunctionType, function))
    begin_step, request_voltage = (
        internal(equations.begin_step),
        internal(equations.request_voltage),
    )
    advance_sample, end_step = internal(equations.advance_sample), internal(equations.end_step)
    source_current = internal(equations.source_current)
    step_type, piece_type, sampled_type, averages_type = _PARTS
    piece_at, sampled_at, averages_at = _OFFSETS[1:]
    parameters_of, state_of, num_states = _PARAMETERS, State, _NUM_STATES

    @internal
    def inputs_of(row: int) -> Inputs:
        values = f64(row)
        return Inputs(values[4], values[5], values[6], values[7], values[8], values[9])

    @cfunc(types.float64(types.uintp, types.int64, types.float64), nogil=True, error_model="numpy")
    def advance(rows: int, count: int, timestep: float) -> float:
        memory = stack_floats(WORK_SIZE * count)
        work = entry_address(memory, 0)
        supply = read(u64(rows)[1], parameters_of)
        for motor in range(count):
            row, parts = rows + 8 * ROW_SIZE * motor, work + 8 * WORK_SIZE * motor
            step, piece, sampled = begin_step(
                read(u64(row)[1], parameters_of),
                timestep,
                read(u64(row)[2], state_of),
                inputs_of(row),
                f64(row)[0] != 0.0,
                supply.sample_rate,
            )
            write(step, parts)
            write(piece, parts + piece_at)
            write(sampled, parts + sampled_at)
            write(StepAverages(0.0, 0.0, 0.0, 0.0, 0.0, 0.0), parts + averages_at)
        volts, amperes = 0.0, 0.0
        samples = max(int(timestep * supply.sample_rate + 0.5), 1)
        for _ in range(samples):
            for motor in range(count):
                row, parts = rows + 8 * ROW_SIZE * motor, work + 8 * WORK_SIZE * motor
                sampled = read(parts + sampled_at, sampled_type)
                command, requested = request_voltage(
                    read(u64(row)[1], parameters_of),
                    read(parts, step_type),
                    read(parts + piece_at, piece_type),
                    sampled,
                    f64(row)[0] != 0.0,
                )
                memory[WORK_SIZE * motor + _COMMAND] = command
                memory[WORK_SIZE * motor + REQUESTED] = requested
                memory[WORK_SIZE * motor + CURRENT] = sampled.current
            voltage = bus_voltage(
                *(memory, WORK_SIZE, count, supply.supply_voltage, supply.supply_resistance),
                supply.supply_recharges != 0.0,
            )
            supplied = 0.0
            for motor in range(count):
                row, parts = rows + 8 * ROW_SIZE * motor, work + 8 * WORK_SIZE * motor
                piece, sampled, averages, bridge_current = advance_sample(
                    read(u64(row)[1], parameters_of),
                    timestep,
                    read(parts, step_type),
                    read(parts + piece_at, piece_type),
                    read(parts + sampled_at, sampled_type),
                    read(parts + averages_at, averages_type),
                    memory[WORK_SIZE * motor + _COMMAND],
                    memory[WORK_SIZE * motor + REQUESTED],
                    voltage,
                    f64(row)[0] != 0.0,
                )
                write(piece, parts + piece_at)
                write(sampled, parts + sampled_at)
                write(averages, parts + averages_at)
                supplied += bridge_current
            volts, amperes = volts + voltage, amperes + source_current(supply, supplied)
        for motor in range(count):
            row, parts = rows + 8 * ROW_SIZE * motor, work + 8 * WORK_SIZE * motor
            state = u64(row)[2]
            after, torque, signals = end_step(
                read(u64(row)[1], parameters_of),
                timestep,
                read(state, state_of),
                inputs_of(row),
                read(parts, step_type),
                read(parts + sampled_at, sampled_type),
                read(parts + averages_at, averages_type),
                f64(row)[0] != 0.0,
                volts / samples,
                amperes / samples,
            )
            write(after, state + 8 * num_states)
            write(signals, state + 16 * num_states)
            f64(u64(row)[3])[0] = torque
        return 0.0

    _FUNCTION_ADDRESS[0] = advance.address
    return advance
