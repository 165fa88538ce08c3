"""Simulated motors whose current loop is computed by the exported C code, in another process.

In the step of `Drive`, `Servo` and the paper's `DCMotorActuator` a single function is replaced:
instead of computing the voltage of a sample, it requests the voltage from the process and applies
it to the winding. Nothing else in a motor changes. The state of the loop is sent with each sample
and returned, because the engine may evaluate a step twice.
"""

import contextlib
import ctypes
import math
import subprocess
from collections.abc import Callable, Iterator
from types import FunctionType, ModuleType
from typing import cast

import numpy as np
from numba import types

from codrl_mj.actuators import DCMotorActuator, Drive, Servo, current_loop, drive, servo, shaft
from codrl_mj.actuators.model import Family
from codrl_mj.actuators.parameters import Parameters
from codrl_mj.actuators.shaft import Winding
from codrl_mj.compile_cache import P, R, external_function
from codrl_mj.engine.families import family_replaced
from codrl_mj.engine.memory import entry_address, f64, named_address, u64

TIMEOUT_MS = 5000
"""Time after which a sample counts as unanswered [ms]."""
# POLLIN in the `events` of a `pollfd`, which follow its 32-bit file descriptor.
_POLL_IN = 1 << 32
# Compiled code has no access to Python objects. It shares this table: the settings and counters
# below, the `pollfd` at 1, a sample from 8 on and its answer from 16 on.
_TABLE = np.zeros(32)
_table_address = named_address("codrl_mj_board", _TABLE.ctypes.data)
_WRITE_FD, _AMPERES, _CURRENT_STEP, _VOLTAGE_STEP, _SAMPLES, _LOST = 0, 2, 3, 4, 5, 6
# The C library of this process, whose functions compiled code can call.
_C = ctypes.CDLL(None)
_size = types.uintp
_write = external_function("codrl_mj_board_write", _C.write, types.int64(types.int32, _size, _size))
_read = external_function("codrl_mj_board_read", _C.read, types.int64(types.int32, _size, _size))
_poll = external_function(
    "codrl_mj_board_poll", _C.poll, types.int32(_size, types.uint64, types.int32)
)


def quantized(value: float, step: float) -> float:
    """Return a value rounded to multiples of a step; a step of 0 leaves it unchanged."""
    return step * math.floor(value / step + 0.5) if step > 0.0 else value


def sample_on_board(
    reference: float, measured: float, speed: float, integral: float, memory: float
) -> tuple[float, float, float]:
    """Request a sample of the loop from the board; the voltage is 0 without an answer.

    Args:
        reference: reference current [A].
        measured: measured current [A].
        speed: rotor speed [rad/s].
        integral: state of the loop.
        memory: second state of the loop.

    Returns:
        The voltage [V] and the two states after the sample.
    """
    table = f64(_table_address())
    table[8], table[9], table[10] = (
        reference / table[_AMPERES],
        quantized(measured, table[_CURRENT_STEP]),
        speed,
    )
    table[11], table[12] = integral, memory
    table[_SAMPLES] += 1.0
    received = 0
    # After a lost answer the later ones would belong to other samples, so nothing is sent any more.
    if table[_LOST] == 0.0 and _write(int(table[_WRITE_FD]), entry_address(table, 8), 40) == 40:
        # A pipe may deliver the 24 bytes of an answer in several parts.
        while received < 24 and _poll(entry_address(table, 1), 1, TIMEOUT_MS) > 0:
            count = _read(
                u64(_table_address())[1] & 0xFFFFFFFF,
                entry_address(table, 16) + received,
                24 - received,
            )
            if count <= 0:
                break
            received += count
    if received < 24:
        table[_LOST] = 1.0
        return 0.0, integral, memory
    return quantized(table[16], table[_VOLTAGE_STEP]), table[17], table[18]


def advance_winding(
    parameters: Parameters,
    resistance: float,
    samples: int,
    winding: Winding,
    closed: bool,  # noqa: ARG001 - the loop is closed on the board
    command: float,
    speed: float,
) -> tuple[Winding, float, float, int, float, float]:
    """Advance the winding with a loop that the board closes, sample by sample.

    It replaces `codrl_mj.actuators.shaft.advance_winding`.
    """
    # Over a sample the voltage is constant, so the current decays exponentially from its value to
    # its steady state. `decayed` is the share of the distance that it covers.
    x = resistance / (parameters.sample_rate * parameters.inductance)
    decayed = -math.expm1(-x)
    back_emf = parameters.back_emf_constant * speed
    current, integral, pending = winding
    num_saturated, current_sum, voltage_sum, power_sum, heat_sum = 0, 0.0, 0.0, 0.0, 0.0
    for _ in range(samples):
        limit = max(parameters.supply_voltage - parameters.supply_resistance * abs(current), 0.0)
        applied, integral, pending = sample_on_board(command, current, speed, integral, pending)
        applied = min(max(applied, -limit), limit)
        num_saturated += abs(applied) >= limit
        if parameters.deadband > 0.0:
            applied = math.copysign(max(abs(applied) - parameters.deadband, 0.0), applied)
        steady_current = (applied - back_emf) / resistance
        deviation = current - steady_current
        # Mean over the sample of the current, which decays exponentially to the steady current.
        mean_current = steady_current + deviation * decayed / x
        heat_sum += (
            steady_current * steady_current
            + deviation
            * (2.0 * steady_current * decayed + deviation * decayed * (1.0 - 0.5 * decayed))
            / x
        )
        current_sum = current_sum + mean_current
        voltage_sum = voltage_sum + applied
        power_sum = power_sum + applied * mean_current
        current = steady_current + deviation * (1.0 - decayed)
    after = Winding(current, integral, pending)
    return (
        after,
        current_sum / samples,
        voltage_sum / samples,
        num_saturated,
        power_sum / samples,
        resistance * heat_sum / samples,
    )


def electrical_step(
    parameters: Parameters,
    dt: float,
    current: float,
    integral: float,
    previous_error: float,
    desired_torque: float,
    speed: float,
    sensor_error: float,
    limit: float,
) -> tuple[float, float, float, float]:
    """Take an electrical step of which the board computes the voltage.

    It replaces `codrl_mj.actuators.electrical_step`, with the same arguments and results.
    """
    reference = desired_torque / parameters.torque_constant
    voltage, integral, error = sample_on_board(
        reference, current + sensor_error, speed, integral, previous_error
    )
    voltage = min(max(voltage, -limit), limit)
    back_emf = parameters.back_emf_constant * speed
    current = (
        current
        + (voltage - back_emf - parameters.resistance * current) / parameters.inductance * dt
    )
    return current, integral, error, voltage


def _replace_globals(function: Callable[P, R], **replacements: object) -> Callable[P, R]:
    """Return a copy of a function with some of its globals replaced."""
    # The families' own source must run here, step for step, with only the electrical step replaced.
    # A second implementation would have to be kept equal, an argument for the step would cost every
    # simulation time, and replacing the module's own name would change other threads' motors.
    original = cast(FunctionType, function)
    return FunctionType(
        original.__code__,
        {**original.__globals__, **replacements},
        original.__name__,
        original.__defaults__,
    )


# A copy of the module, in which `advance_motor` calls this module's `advance_winding`.
_shaft = ModuleType(shaft.__name__)
vars(_shaft).update(
    vars(shaft),
    advance_motor=_replace_globals(shaft.advance_motor, advance_winding=advance_winding),
)
_ADVANCE: dict[Family, Callable[..., object]] = {
    Drive: _replace_globals(drive.advance, _advance=_replace_globals(drive._advance, shaft=_shaft)),
    Servo: _replace_globals(servo.advance, shaft=_shaft),
    DCMotorActuator: _replace_globals(current_loop.advance, electrical_step=electrical_step),
}


@contextlib.contextmanager
def loop_on_board(
    family: Family,
    process: subprocess.Popen[bytes],
    amperes: float,
    current_step: float = 0.0,
    voltage_step: float = 0.0,
) -> Iterator[np.ndarray]:
    """Let motors of a family request the voltage of each sample from a process in a `with` block.

    Args:
        family: `Drive`, `Servo` or `DCMotorActuator`.
        process: process with pipes that runs `board.c`, compiled with `BOARD_DRIVE`.
        amperes: current [A] for a command of 1.
        current_step: resolution of the measured current [A]; 0 for none.
        voltage_step: resolution of the bridge's voltage [V]; 0 for none.

    Returns:
        A view of two numbers: the number of samples, and 1 if a sample was not answered.
    """
    board_family = type(
        family.__name__, (family,), {"advance": staticmethod(_ADVANCE[family]), "family": ""}
    )
    assert process.stdin is not None
    assert process.stdout is not None
    _TABLE[:] = 0.0
    _TABLE[[_WRITE_FD, _AMPERES, _CURRENT_STEP, _VOLTAGE_STEP]] = (
        process.stdin.fileno(),
        amperes,
        current_step,
        voltage_step,
    )
    _TABLE[1:2].view(np.uint64)[0] = process.stdout.fileno() | _POLL_IN
    with family_replaced(family, board_family):
        yield _TABLE[_SAMPLES : _LOST + 1]
