"""Frames between a host and an exported controller, as the exported `wire.h` describes them, over a stream of bytes."""

import binascii
import contextlib
import os
import select
import struct
import time
from typing import NamedTuple

import numpy as np

from codrl_mj.deploy.contract import Contract

ASK, WATCH, DRIVE = 0, 1, 2
"""What is asked for: the policy's command for the observation that is sent; that for the
controller's own observation, which it does not give to the drive; or does.
"""
DAMAGED, OLD, NOT_FINITE, LATE, BEYOND, NO_SENSORS = (1 << bit for bit in range(6))
REFUSED = DAMAGED | OLD | NOT_FINITE
"""Bits of an answer's status with which the policy was not asked for the frame's sake."""
ANSWER_WITHIN = 5.0
"""Seconds after which a frame counts as not answered."""
_START = b"\xa5\x5a"


class Answer(NamedTuple):
    """What came back."""

    sequence: int
    """That of the frame, modulo 256."""
    status: int
    """Bits of `DAMAGED` and so on."""
    observation: np.ndarray
    """That which the policy took, shape (k,)."""
    command: np.ndarray
    """In the units of the contract, shape (m,)."""
    motors: np.ndarray
    """Voltage [V], current [A] and position of the rotor [rad] of each motor, shape (m, 3); 0 where not measured."""


class Wire:
    """One end of it."""

    def __init__(self, contract: Contract, to: int, back: int) -> None:
        """Speak to a controller through two file descriptors, which may be the same."""
        kind = "d" if contract.controller["real"] == "double" else "f"
        self._sizes = len(contract.observations), len(contract.actions)
        self._request = struct.Struct(f"<BBI{self._sizes[0]}{kind}")
        self._answer = struct.Struct(f"<BBI{self._sizes[0] + 4 * self._sizes[1]}{kind}")
        self._to, self._back, self._got = to, back, bytearray()

    def frame(self, sequence: int, stamp: int, observation: np.ndarray, kind: int = ASK) -> bytes:
        """A frame with an observation (k,), at a time [us]."""
        return _framed(
            self._request.pack(sequence % 256, kind, stamp % 2**32, *observation.tolist())
        )

    def asked(self, frame: bytes, sequence: int, within: float = ANSWER_WITHIN) -> Answer | None:
        """Send a frame, and what comes back within some time [s]; None for nothing, or what is damaged.

        Raises:
            RuntimeError: the controller ended.
        """
        with contextlib.suppress(BrokenPipeError):  # reading says that it ended
            os.write(self._to, frame)
        while (answer := self._read(sequence, within)) is not None:
            if (
                answer.sequence == sequence % 256 or answer.status & DAMAGED
            ):  # and not one that came too late
                return answer
        return None

    def _read(self, sequence: int, within: float) -> Answer | None:
        """The next answer."""
        size, got, damaged = self._answer.size + 4, self._got, False
        until = time.monotonic() + within
        while True:
            begin = got.find(_START)
            del got[
                : begin if begin >= 0 else len(got) - got.endswith(_START[:1])
            ]  # noise before it
            if len(got) >= size:
                content = bytes(got[2 : size - 2])
                damaged = got[:size] != _framed(content)
                del got[
                    : 1 if damaged else size
                ]  # within what is damaged may be the start of one that is not
                if not damaged:
                    break
            elif damaged and not got:
                return None
            else:
                ready = select.select([self._back], [], [], max(0.0, until - time.monotonic()))[0]
                if not ready:
                    return None
                more = os.read(self._back, size)
                if not more:
                    raise RuntimeError(f"the board's program ended at frame {sequence}")
                got += more
        answered, status, _, *numbers = self._answer.unpack(content)
        seen, command, motors = np.split(np.array(numbers), np.cumsum(self._sizes))
        return Answer(answered, status, seen, command, motors.reshape(-1, 3))


def _framed(content: bytes) -> bytes:
    """A frame: its start, what it says, and their checksum (CRC-16/CCITT, from 0xFFFF)."""
    return _START + content + struct.pack("<H", binascii.crc_hqx(content, 0xFFFF))
