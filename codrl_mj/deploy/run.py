"""A real board behind a serial port: watched, or told to drive, over the exported wire. What it says becomes a log."""

import contextlib
import csv
import math
import time
from collections.abc import Callable, Generator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from codrl_mj.deploy.contract import Contract
from codrl_mj.deploy.log import columns, motor_columns
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

MOST_MISSED = 3
"""Frames in a row without an answer, after which a board is no longer told to drive."""


class BoardRun(NamedTuple):
    """How it went."""

    rows: int
    """Answers that were logged."""
    missed: int
    """Frames without an answer."""
    late: int
    """Frames that came to the board later than its contract allows."""
    why: str
    """What ended it."""


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
    """Ask a board for its observations and commands at the policy's rate, until told otherwise.

    It ends with a frame that puts the command to that for safety. Told to drive, it ends by itself
    as soon as something is wrong: here again, whatever the C finds.

    Args:
        folder: what `codrl_mj.deploy.export` wrote, and the board runs.
        port: serial port, such as `/dev/ttyACM0`.
        log: CSV file for what it says, as `check_log` reads it, with the motors' voltage, current
            and position.
        drive: whether the board gives the commands to its drive; else it only says which they would
            be.
        seconds: how long at most [s].
        baud: bits a second.
        ended: asked before each frame whether to end.
        on_answer: told of each answer.

    Raises:
        FileNotFoundError: the folder has no contract.
        RuntimeError: the board has no sensors, or there is none at the port.
    """
    contract = Contract.read(folder)
    rows, missed, in_a_row, late, why = 0, 0, 0, 0, ""
    with _opened(port, baud) as line, atomic_write(log) as part, part.open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(columns(contract) + motor_columns(contract))
        wire = Wire(contract, line.fileno(), line.fileno())
        asking = _asked(
            contract, wire, DRIVE if drive else WATCH, lambda now: ended() or now >= seconds
        )
        try:
            for now, answer in asking:
                in_a_row = 0 if answer else in_a_row + 1
                missed += answer is None
                if answer is not None:
                    if answer.status & NO_SENSORS:
                        raise RuntimeError(
                            f"{port}: the board has no sensors: give it wire_sense (docs/deploy.md)"
                        )
                    late += bool(answer.status & LATE)
                    if not answer.status & DAMAGED:  # whose bytes are no observation
                        rows += 1
                        table.writerow(
                            [now, *answer.observation, *answer.command, *answer.motors.ravel()]
                        )
                    if on_answer is not None:
                        on_answer(answer)
                if drive and (why := _wrong(contract, answer, in_a_row)):
                    break
        except (KeyboardInterrupt, OSError) as error:  # what was logged is kept
            why = f"interrupted: {error or type(error).__name__}"
        finally:
            with contextlib.suppress(OSError, RuntimeError):
                asking.close()
    return BoardRun(rows, missed, late, why or "told to")


def _asked(
    contract: Contract, wire: Wire, kind: int, ended: Callable[[float], bool]
) -> Generator[tuple[float, Answer | None]]:
    """Time [s] and answer of a frame each at the policy's rate, until it ended; then one that puts it to safety."""
    nothing, within, period = (
        np.zeros(len(contract.observations)),
        float(contract.late["after"]),
        1.0 / contract.rate,
    )
    began = due = time.monotonic()
    sequence = 0
    try:
        while not ended(now := time.monotonic() - began):
            sequence, stamp = sequence + 1, int(1e6 * now) + 1
            yield (
                stamp / 1e6,
                wire.asked(wire.frame(sequence, stamp, nothing, kind), sequence, within),
            )
            due += period
            wait = due - time.monotonic()
            if wait < -period:  # after a pause no burst of frames
                due -= wait
            time.sleep(max(0.0, wait))
    finally:
        stamp = int(1e6 * (time.monotonic() - began)) + 2
        wire.asked(wire.frame(sequence + 1, stamp, nothing, WATCH), sequence + 1, within)


def _opened(port: str, baud: int) -> Any:
    """The serial port."""
    import serial

    try:
        return serial.Serial(port, baud, timeout=0, exclusive=True)
    except serial.SerialException as error:
        raise RuntimeError(
            f"--port {port}: {error}; is the board plugged in, and may you open it?"
        ) from None


def _wrong(contract: Contract, answer: Answer | None, in_a_row: int) -> str:
    """Why a board must not go on to drive; empty where it may."""
    if answer is None:
        return f"{in_a_row} frames in a row had no answer" if in_a_row >= MOST_MISSED else ""
    if answer.status & OLD:
        return "the board took a frame for old: it heard of a later time, before this run: reset it"
    if answer.status & (DAMAGED | NOT_FINITE):
        return (
            "the board took a frame for damaged"
            if answer.status & DAMAGED
            else "a sensor says no finite number"
        )
    if answer.status & BEYOND or not contract.within(answer.observation[np.newaxis])[0]:
        names = [one["name"] for one in contract.observations]
        return (
            "beyond the limits:"
            f" {dict(zip(names, answer.observation.round(4).tolist(), strict=True))}"
        )
    bounds = [one.get("levels") or [one.get("least"), one.get("most")] for one in contract.actions]
    most = [math.inf if None in some else max(map(abs, some)) for some in bounds]
    if not (np.abs(answer.command) <= np.array(most) * (1.0 + 1e-6)).all():
        return f"the command is {answer.command.tolist()}, beyond what the policy was trained with"
    return ""
