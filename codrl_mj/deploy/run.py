"""Runs of a real board at a serial port, which only reports or also drives, and their logs."""

import contextlib
import csv
import math
import time
from collections.abc import Callable, Generator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from codrl_mj.deploy.contract import Contract
from codrl_mj.deploy.log import column_names, motor_column_names
from codrl_mj.deploy.wire import (
    BEYOND,
    DAMAGED,
    DRIVE,
    LATE,
    NO_SENSORS,
    NOT_FINITE,
    OLD,
    WATCH,
    Answer,
    Wire,
)
from codrl_mj.runs.files import atomic_write

# pyserial is optional, and is imported where a port is opened.
SerialPort = Any
"""A `serial.Serial`."""
MAX_MISSED = 3
"""Number of consecutive frames without an answer that ends a run which drives the motor."""


class BoardRun(NamedTuple):
    """Result of a run of a board."""

    rows: int
    """Number of logged answers."""
    missed: int
    """Number of frames without an answer."""
    late: int
    """Number of frames that reached the board later than the contract allows."""
    reason: str
    """Reason for the end of the run."""


def run_board(
    folder: Path,
    port: str,
    log: Path,
    drive: bool = False,
    seconds: float = math.inf,
    baud: int = 115_200,
    ended: Callable[[], bool] = lambda: False,
    on_answer: Callable[[Answer], None] | None = None,
) -> BoardRun:
    """Request a board's observations and commands at the policy's rate until the run is ended.

    The last frame sets the safe command. A run that drives the motor also ends on the first error;
    Python checks for errors in addition to the C code.

    Args:
        folder: a folder that `codrl_mj.deploy.export` wrote and that the board runs.
        port: serial port, such as `/dev/ttyACM0`.
        log: CSV file for the answers, in the format of `check_log`, with the motors' voltage,
            current and position.
        drive: True if the board gives the commands to its drive; otherwise it only reports them.
        seconds: longest duration [s].
        baud: bits per second.
        ended: predicate that is called before each frame; True ends the run.
        on_answer: callback for each answer.

    Raises:
        FileNotFoundError: the folder has no contract.
        RuntimeError: the board has no sensors, or there is none at the port.
    """
    contract = Contract.read(folder)
    rows, missed, num_consecutive, late, reason = 0, 0, 0, 0, ""
    with (
        _open_port(port, baud) as line,
        atomic_write(log) as part,
        part.open("w", newline="") as file,
    ):
        table = csv.writer(file)
        table.writerow(column_names(contract) + motor_column_names(contract))
        wire = Wire(contract, line.fileno(), line.fileno())
        exchanges = _exchange_frames(
            contract, wire, DRIVE if drive else WATCH, lambda now: ended() or now >= seconds
        )
        try:
            for now, answer in exchanges:
                num_consecutive = 0 if answer else num_consecutive + 1
                missed += answer is None
                if answer is not None:
                    if answer.status & NO_SENSORS:
                        raise RuntimeError(
                            f"{port}: the board has no sensors: give it wire_sense (docs/deploy.md)"
                        )
                    late += bool(answer.status & LATE)
                    # A damaged frame has no valid observation.
                    if not answer.status & DAMAGED:
                        rows += 1
                        table.writerow(
                            [now, *answer.observation, *answer.command, *answer.motors.ravel()]
                        )
                    if on_answer is not None:
                        on_answer(answer)
                if drive and (reason := _stop_reason(contract, answer, num_consecutive)):
                    break
        # The run ends normally, so that the log is kept.
        except (KeyboardInterrupt, OSError) as error:
            reason = f"interrupted: {error or type(error).__name__}"
        finally:
            # Closing the generator sends the frame with the safe command.
            with contextlib.suppress(OSError, RuntimeError):
                exchanges.close()
    return BoardRun(rows, missed, late, reason or "requested")


def _exchange_frames(
    contract: Contract, wire: Wire, kind: int, ended: Callable[[float], bool]
) -> Generator[tuple[float, Answer | None]]:
    """Yield the time [s] and the answer of each frame, sent at the policy's rate.

    When the run ends or the generator is closed, a last frame sets the safe command.
    """
    zeros = np.zeros(len(contract.observations))
    timeout = float(contract.late["after"])
    period = 1.0 / contract.rate
    start = due = time.monotonic()
    sequence = 0
    try:
        while not ended(elapsed := time.monotonic() - start):
            sequence, stamp = sequence + 1, int(1e6 * elapsed) + 1
            yield (
                stamp / 1e6,
                wire.request(wire.frame(sequence, stamp, zeros, kind), sequence, timeout),
            )
            due += period
            wait = due - time.monotonic()
            # After a pause the missed frames are not sent in a burst.
            if wait < -period:
                due -= wait
            time.sleep(max(0.0, wait))
    finally:
        stamp = int(1e6 * (time.monotonic() - start)) + 2
        wire.request(wire.frame(sequence + 1, stamp, zeros, WATCH), sequence + 1, timeout)


def _open_port(port: str, baud: int) -> SerialPort:
    """Open the serial port."""
    import serial

    try:
        return serial.Serial(port, baud, timeout=0, exclusive=True)
    except serial.SerialException as error:
        raise RuntimeError(
            f"--port {port}: {error}; is the board plugged in, and may you open the port?"
        ) from None


def _stop_reason(contract: Contract, answer: Answer | None, num_consecutive: int) -> str:
    """Return the reason why a board must stop driving; "" if it may continue."""
    if answer is None:
        return (
            f"{num_consecutive} frames in a row had no answer"
            if num_consecutive >= MAX_MISSED
            else ""
        )
    if answer.status & OLD:
        return (
            "the board refused a frame as old: it received a frame with a later time before this"
            " run: reset the board"
        )
    if answer.status & (DAMAGED | NOT_FINITE):
        return (
            "the board refused a frame as damaged"
            if answer.status & DAMAGED
            else "a sensor's value is not finite"
        )
    if answer.status & BEYOND or not contract.is_within_limits(answer.observation[np.newaxis])[0]:
        names = [entry["name"] for entry in contract.observations]
        return (
            "the observation is beyond the limits:"
            f" {dict(zip(names, answer.observation.round(4).tolist(), strict=True))}"
        )
    bounds: list[Sequence[float | None]] = [
        action.get("levels") or [action.get("least"), action.get("most")]
        for action in contract.actions
    ]
    largest = [
        math.inf if None in values else max(abs(value) for value in values if value is not None)
        for values in bounds
    ]
    # The comparison is negated so that a NaN also ends the run.
    if not (np.abs(answer.command) <= np.array(largest) * (1.0 + 1e-6)).all():
        return f"the command is {answer.command.tolist()}, beyond the bounds of the training"
    return ""
