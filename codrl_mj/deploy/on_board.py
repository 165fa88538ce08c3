"""The current loop of the exported C in the simulation's motor: each sample is asked of a process, the winding is here.

A family's own step runs with one function of it replaced: where `Drive` and `Servo` compute samples
of their loop, and the paper's `DCMotorActuator` its one, these ask for a voltage and bring it to the
winding. Nothing else of a motor changes. The loop's memory goes with each sample and comes back,
since the engine may ask for a step twice.
"""

import contextlib
import ctypes
import math
from collections.abc import Iterator
from types import FunctionType, ModuleType
from typing import Any

import numpy as np
from numba import types

from codrl_mj.actuators import DCMotorActuator, Drive, Servo, current_loop, drive, servo, shaft
from codrl_mj.actuators.model import Family
from codrl_mj.actuators.shaft import Winding
from codrl_mj.compile_cache import external
from codrl_mj.engine.families import replaced
from codrl_mj.engine.memory import at, f64, symbol, u64

WITHIN = 5000
"""Milliseconds after which a sample counts as not answered."""
_POLL_IN = 1 << 32
_TABLE = np.zeros(
    32
)  # these, and 1: what `poll` is told; from 8 on a sample, from 16 on its answer
_table_at = symbol("codrl_mj_board", _TABLE.ctypes.data)
_TO, _AMPERES, _CURRENT, _VOLTAGE, _SAMPLES, _LOST = 0, 2, 3, 4, 5, 6
_C: Any = ctypes.CDLL(None)
_size = types.uintp
_write = external("codrl_mj_board_write", _C.write, types.int64(types.int32, _size, _size))
_read = external("codrl_mj_board_read", _C.read, types.int64(types.int32, _size, _size))
_poll = external("codrl_mj_board_poll", _C.poll, types.int32(_size, types.uint64, types.int32))


def rounded(value: float, step: float) -> float:
    """A value as a converter with such a step sees it; 0: as it is."""
    return step * math.floor(value / step + 0.5) if step > 0.0 else value


def asked_of_board(
    reference: float, measured: float, speed: float, integral: float, kept: float
) -> tuple[float, float, float]:
    """The voltage [V] of a sample and the loop's memory after it, by [A], [A], [rad/s] and its memory; 0 V if none."""
    table = f64(_table_at())
    table[8], table[9], table[10] = (
        reference / table[_AMPERES],
        rounded(measured, table[_CURRENT]),
        speed,
    )
    table[11], table[12] = integral, kept
    table[_SAMPLES] += 1.0
    got = 0
    if table[_LOST] == 0.0 and _write(int(table[_TO]), at(table, 8), 40) == 40:
        while got < 24 and _poll(at(table, 1), 1, WITHIN) > 0:
            count = _read(u64(_table_at())[1] & 0xFFFFFFFF, at(table, 16) + got, 24 - got)
            if count <= 0:
                break
            got += count
    if got < 24:
        table[_LOST] = 1.0
        return 0.0, integral, kept
    return rounded(table[16], table[_VOLTAGE]), table[17], table[18]


def advance_winding(
    parameters: Any,
    resistance: float,
    samples: int,
    winding: Winding,
    closed: bool,  # noqa: ARG001 - it is
    asked: float,
    speed: float,
) -> tuple[Winding, float, float, int, float, float]:
    """`codrl_mj.actuators.shaft.advance_winding` of a loop that is closed on the board, sample by sample."""
    x = resistance / (parameters.sample_rate * parameters.inductance)
    lost = -math.expm1(-x)
    back_emf = parameters.back_emf_constant * speed
    current, integral, pending = winding
    saturated, mean, volts, power, heat = 0, 0.0, 0.0, 0.0, 0.0
    for _ in range(samples):
        limit = max(parameters.supply_voltage - parameters.supply_resistance * abs(current), 0.0)
        applied, integral, pending = asked_of_board(asked, current, speed, integral, pending)
        applied = min(max(applied, -limit), limit)
        saturated += abs(applied) >= limit
        if parameters.deadband > 0.0:
            applied = math.copysign(max(abs(applied) - parameters.deadband, 0.0), applied)
        reached = (applied - back_emf) / resistance
        off = current - reached
        within = reached + off * lost / x  # the sample's mean current
        heat += (
            reached * reached + off * (2.0 * reached * lost + off * lost * (1.0 - 0.5 * lost)) / x
        )
        mean, volts, power = mean + within, volts + applied, power + applied * within
        current = reached + off * (1.0 - lost)
    after = Winding(current, integral, pending)
    return (
        after,
        mean / samples,
        volts / samples,
        saturated,
        power / samples,
        resistance * heat / samples,
    )


def electrical_step(
    parameters: Any,
    dt: float,
    current: float,
    integral: float,
    previous_error: float,
    desired_torque: float,
    speed: float,
    sensor_error: float,
    limit: float,
) -> tuple[float, float, float, float]:
    """`codrl_mj.actuators.electrical_step` of a loop on the board."""
    asked = desired_torque / parameters.torque_constant
    voltage, integral, error = asked_of_board(
        asked, current + sensor_error, speed, integral, previous_error
    )
    voltage = min(max(voltage, -limit), limit)
    back_emf = parameters.back_emf_constant * speed
    current = (
        current
        + (voltage - back_emf - parameters.resistance * current) / parameters.inductance * dt
    )
    return current, integral, error, voltage


def _with(function: Any, **others: Any) -> Any:
    """A function of which some globals are others."""
    return FunctionType(
        function.__code__,
        {**function.__globals__, **others},
        function.__name__,
        function.__defaults__,
    )


_shaft = ModuleType("codrl_mj.actuators.shaft")
vars(_shaft).update(vars(shaft), advance_motor=_with(shaft.advance_motor, advance_winding=advance_winding))
_ADVANCE = {
    Drive: _with(drive.advance, _advance=_with(drive._advance, shaft=_shaft)),
    Servo: _with(servo.advance, shaft=_shaft),
    DCMotorActuator: _with(current_loop.advance, electrical_step=electrical_step),
}


@contextlib.contextmanager
def loop_on_board(
    family: Family,
    process: Any,
    amperes: float,
    current_step: float = 0.0,
    voltage_step: float = 0.0,
) -> Iterator[np.ndarray]:
    """Let motors of a family ask a process for the voltage of each sample, in a `with` block.

    Args:
        family: `Drive`, `Servo` or `DCMotorActuator`.
        process: with pipes, of the program that `board.c` becomes with `BOARD_DRIVE`.
        amperes: what a command of one asks for [A].
        current_step: of the converter that measures the current [A]; 0 for none.
        voltage_step: of the voltages that the bridge can have [V]; 0 for none.

    Returns:
        Where samples are counted, and whether one was not answered: a view of two numbers.
    """
    one = type(
        family.__name__, (family,), {"advance": staticmethod(_ADVANCE[family]), "family": ""}
    )
    _TABLE[:] = 0.0
    _TABLE[[_TO, _AMPERES, _CURRENT, _VOLTAGE]] = (
        process.stdin.fileno(),
        amperes,
        current_step,
        voltage_step,
    )
    _TABLE[1:2].view(np.uint64)[0] = process.stdout.fileno() | _POLL_IN
    with replaced(family, one):
        yield _TABLE[_SAMPLES : _LOST + 1]
