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
"""What is asked for: the policy's command for the observation that is sent; that for the controller's own observation,
which it does not give to the drive; or does."""
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
    stamp: int
    """Time [us] of the frame, modulo 2^32."""
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
        self._to, self._back = to, back

    def frame(self, sequence: int, stamp: int, observation: np.ndarray, kind: int = ASK) -> bytes:
        """A frame with an observation (k,), at a time [us]."""
        return _framed(self._request.pack(sequence % 256, kind, stamp % 2**32, *observation.tolist()))

    def asked(self, frame: bytes, sequence: int, within: float = ANSWER_WITHIN) -> Answer | None:
        """Send a frame, and what comes back within some time [s]; None for nothing, or what is damaged.

        Raises:
            RuntimeError: the controller ended.
        """
        with contextlib.suppress(BrokenPipeError):  # reading says that it ended
            os.write(self._to, frame)
        while (answer := self._read(sequence, within)) is not None:
            if answer.sequence == sequence % 256 or answer.status & DAMAGED:  # and not one that came too late
                return answer
        return None

    def _read(self, sequence: int, within: float) -> Answer | None:
        """The next answer."""
        size, got = self._answer.size + 4, b""
        until = time.monotonic() + within
        while len(got) < size:
            ready = select.select([self._back], [], [], max(0.0, until - time.monotonic()))[0]
            more = os.read(self._back, size - len(got)) if ready else b""
            if ready and not more:
                raise RuntimeError(f"the board's program ended at frame {sequence}")
            if not ready:
                return None
            got += more
            got = got[max(got.find(_START[0]), 0) :] if got[:1] != _START[:1] else got  # noise before it
        if got != _framed(got[2:-2]):
            return None
        answered, status, stamp, *numbers = self._answer.unpack(got[2:-2])
        seen, command, motors = np.split(np.array(numbers), np.cumsum(self._sizes))
        return Answer(answered, status, stamp, seen, command, motors.reshape(-1, 3))


def _framed(content: bytes) -> bytes:
    """A frame: its start, what it says, and their checksum (CRC-16/CCITT, from 0xFFFF)."""
    return _START + content + struct.pack("<H", binascii.crc_hqx(content, 0xFFFF))
