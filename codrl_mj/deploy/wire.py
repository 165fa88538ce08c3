"""Frames between a host and an exported controller over a byte stream; see `wire.h`."""

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
"""Kinds of frames.

ASK requests the policy's command for the observation in the frame; WATCH requests the command for
the controller's sensors, without giving it to the drive; DRIVE also gives it to the drive.
"""
DAMAGED, OLD, NOT_FINITE, LATE, BEYOND, NO_SENSORS = (1 << bit for bit in range(6))
REFUSED = DAMAGED | OLD | NOT_FINITE
"""Status bits of frames that the controller refused, so that the policy was not evaluated."""
ANSWER_TIMEOUT = 5.0
"""Time after which a frame counts as unanswered [s]."""
_START = b"\xa5\x5a"
"""First two bytes of a frame."""


class Answer(NamedTuple):
    """Answer of a controller to a frame."""

    sequence: int
    """Number of the frame, modulo 256."""
    status: int
    """Bits such as `DAMAGED`."""
    observation: np.ndarray
    """Observation that the policy used, shape (k,)."""
    command: np.ndarray
    """Command in the units of the contract, shape (m,)."""
    motors: np.ndarray
    """Voltage [V], current [A] and rotor angle [rad] of each motor, shape (m, 3); 0 if unknown."""


class Wire:
    """The host's end of a connection to a controller."""

    def __init__(self, contract: Contract, write_fd: int, read_fd: int) -> None:
        """Use two file descriptors, which may be the same, for writing and for reading."""
        kind = "d" if contract.controller["real"] == "double" else "f"
        self._sizes = len(contract.observations), len(contract.actions)
        self._request = struct.Struct(f"<BBI{self._sizes[0]}{kind}")
        self._answer = struct.Struct(f"<BBI{self._sizes[0] + 4 * self._sizes[1]}{kind}")
        self._write_fd, self._read_fd, self._buffer = write_fd, read_fd, bytearray()

    def frame(self, sequence: int, stamp: int, observation: np.ndarray, kind: int = ASK) -> bytes:
        """Return the bytes of a frame with an observation (k,) and a time [us]."""
        return _framed(
            self._request.pack(sequence % 256, kind, stamp % 2**32, *observation.tolist())
        )

    def request(
        self, frame: bytes, sequence: int, timeout: float = ANSWER_TIMEOUT
    ) -> Answer | None:
        """Send a frame and return the answer; None if it does not come in time or is damaged.

        Args:
            frame: the bytes of a frame.
            sequence: number of the frame.
            timeout: longest wait for an answer [s].

        Raises:
            RuntimeError: the controller's process has ended.
        """
        # If the controller has ended, the read below raises the error.
        with contextlib.suppress(BrokenPipeError):
            os.write(self._write_fd, frame)
        while (answer := self._read(sequence, timeout)) is not None:
            # Late answers to earlier frames are skipped. The number of a damaged frame is unknown.
            if answer.sequence == sequence % 256 or answer.status & DAMAGED:
                return answer
        return None

    def _read(self, sequence: int, timeout: float) -> Answer | None:
        """Return the next undamaged answer, or None."""
        size, buffer, damaged = self._answer.size + 4, self._buffer, False
        deadline = time.monotonic() + timeout
        while True:
            # Remove noise before the start bytes. The last byte is kept if it may be the first of
            # them.
            start = buffer.find(_START)
            del buffer[: start if start >= 0 else len(buffer) - buffer.endswith(_START[:1])]
            if len(buffer) >= size:
                content = bytes(buffer[2 : size - 2])
                damaged = buffer[:size] != _framed(content)
                # Damaged bytes may contain the start of an undamaged answer.
                del buffer[: 1 if damaged else size]
                if not damaged:
                    break
            elif damaged and not buffer:
                return None
            else:
                ready = select.select(
                    [self._read_fd], [], [], max(0.0, deadline - time.monotonic())
                )[0]
                if not ready:
                    return None
                received = os.read(self._read_fd, size)
                if not received:
                    raise RuntimeError(f"the board's program ended at frame {sequence}")
                buffer += received
        number, status, _, *numbers = self._answer.unpack(content)
        observation, command, motors = np.split(np.array(numbers), np.cumsum(self._sizes))
        return Answer(number, status, observation, command, motors.reshape(-1, 3))


def _framed(content: bytes) -> bytes:
    """Return a frame: start bytes, content, and its CRC-16/CCITT with the initial value 0xFFFF."""
    return _START + content + struct.pack("<H", binascii.crc_hqx(content, 0xFFFF))
