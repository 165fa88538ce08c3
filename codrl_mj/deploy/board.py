"""The exported C as the controller of the simulation: compiled, run here or on an emulated board, asked over a wire."""

import binascii
import contextlib
import dataclasses
import os
import select
import shutil
import struct
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from codrl_mj.deploy.contract import Contract
from codrl_mj.envs.config import EnvConfig
from codrl_mj.evaluation import Episode, run_episodes
from codrl_mj.fields import check_names

SOURCES = ("controller.c", "wire.c", "board.c")
_STRICT = ["-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-Wconversion"]
_CORTEX = "-mcpu=cortex-m4 -mthumb -mfloat-abi=hard -mfpu=fpv4-sp-d16 -ffreestanding -nostartfiles -DBOARD_SEMIHOSTING"
_QEMU = "qemu-system-arm -M mps2-an386 -display none -monitor none -serial none -semihosting-config"
TARGETS = {  # name -> what it needs: program -> the package of Debian's that has it
    "host": {"cc": "gcc"},
    "cortex-m4f": {
        "arm-none-eabi-gcc": "gcc-arm-none-eabi libnewlib-arm-none-eabi",
        "qemu-system-arm": "qemu-system-arm",
    },
}
ANSWER_WITHIN = 5.0
"""Seconds after which a frame counts as not answered."""
_START = b"\xa5\x5a"


def missing_tools(target: str) -> str:
    """What installs the tools that a target lacks; empty where it lacks none. An unknown target is refused."""
    check_names([target], TARGETS, "target")
    lacking = [package for program, package in TARGETS[target].items() if not shutil.which(program)]
    return f"apt-get install {' '.join(lacking)}" if lacking else ""


class OnnxPolicy:
    """The policy of an exported folder by onnxruntime, chosen as other policies are."""

    def __init__(self, folder: Path) -> None:
        """Load what `codrl_mj.deploy.export` wrote into a folder."""
        import onnxruntime

        self.session = onnxruntime.InferenceSession(folder / "policy.onnx", providers=["CPUExecutionProvider"])

    def predict(
        self,
        observation: np.ndarray,
        *,
        deterministic: bool = True,  # noqa: ARG002 - the protocol's
    ) -> tuple[np.ndarray, Any]:
        """Actions (N, m) or (N,) for observations (N, k)."""
        return self.session.run(None, {"observation": observation.astype(np.float32)})[0], None


class Board:
    """A policy that is computed by the exported C, in a process of its own, and asked frame by frame in lock step.

    A context manager: the process ends with it. Where no answer comes, the contract's command for safety is taken.
    """

    def __init__(
        self, folder: Path, target: str = "host", lost: float = 0.0, damaged: float = 0.0, seed: int = 0
    ) -> None:
        """Compile the C and start it.

        Args:
            folder: what `codrl_mj.deploy.export` wrote.
            target: `host`, or `cortex-m4f`, which QEMU emulates.
            lost: share of the frames that never arrive.
            damaged: share of them in which a bit has flipped.
            seed: of which frames these are.

        Raises:
            FileNotFoundError: the folder has no contract or no C.
            ValueError: the target is unknown, or a share not in [0, 1].
            RuntimeError: a tool is missing (the message installs it), or the C does not compile.
        """
        for name, share in (("lost", lost), ("damaged", damaged)):
            if not 0.0 <= share <= 1.0:
                raise ValueError(f"{name} = {share}: must be a share of the frames, from 0 to 1")
        if install := missing_tools(target):
            raise RuntimeError(f"target {target}: its tools are missing: {install}")
        self.contract = Contract.read(folder)
        self.lost, self.damaged, self.random = lost, damaged, np.random.default_rng(seed)
        self.frames, self.refused, self.unanswered = 0, 0, 0
        with contextlib.ExitStack() as held:
            built = Path(held.enter_context(tempfile.TemporaryDirectory()))
            self.process = subprocess.Popen(
                _build(folder, target, built), stdin=subprocess.PIPE, stdout=subprocess.PIPE
            )
            held.callback(self._stop)
            self._held = held.pop_all()
        kind = "d" if "typedef double real" in (folder / "controller.h").read_text() else "f"
        self._request = struct.Struct(f"<BBI{len(self.contract.observations)}{kind}")
        self._answer = struct.Struct(f"<BBI{len(self.contract.actions)}{kind}")
        self._period = round(1e6 / self.contract.rate)
        self._discrete = np.ndim(self.contract.golden["actions"]) == 1

    def __enter__(self) -> "Board":
        return self

    def __exit__(self, *_: object) -> None:
        self._held.close()

    def predict(
        self,
        observation: np.ndarray,
        *,
        deterministic: bool = True,  # noqa: ARG002 - the protocol's
    ) -> tuple[np.ndarray, Any]:
        """Actions (N, m) or (N,) for observations (N, k), each asked of the board in a frame of its own."""
        commands = np.array([self.command(row) for row in observation])
        if not self._discrete:
            return commands.astype(np.float32), None
        if (levels := self.contract.levels) is None:  # an environment of others: the index itself
            return commands[:, 0].round().astype(np.int64), None
        return np.abs(commands[:, None, :] - levels).sum(axis=2).argmin(axis=1), None

    def command(self, observation: np.ndarray) -> np.ndarray:
        """The command for an observation, in the units of the contract; that for safety if no good answer comes."""
        self.frames += 1
        safe = np.array(self.contract.late["command"])
        sequence, stamp = self.frames % 256, self.frames * self._period % 2**32
        frame = bytearray(_framed(self._request.pack(sequence, 0, stamp, *observation.tolist())))
        if self.random.random() < self.lost:
            self.unanswered += 1
            return safe
        if self.random.random() < self.damaged:
            bit = int(self.random.integers(8 * len(_START), 8 * len(frame)))
            frame[bit // 8] ^= 1 << bit % 8
        assert self.process.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # reading says that the program ended
            self.process.stdin.write(frame)
            self.process.stdin.flush()
        while (answer := self._read()) is not None:
            answered, status, _, *command = self._answer.unpack(answer)
            if answered == sequence or status & 1:  # and not one that came too late; a damaged sequence is sent back
                self.refused += bool(status & 7)  # damaged, old, or not finite
                return np.array(command)
        self.unanswered += 1
        return safe

    def _read(self) -> bytes | None:
        """The next answer without what frames it, None where none comes in time or it is damaged."""
        assert self.process.stdout is not None
        size, got = self._answer.size + 4, b""
        until = time.monotonic() + ANSWER_WITHIN
        while len(got) < size:
            ready = select.select([self.process.stdout], [], [], max(0.0, until - time.monotonic()))[0]
            more = os.read(self.process.stdout.fileno(), size - len(got)) if ready else b""
            if ready and not more:
                raise RuntimeError(f"the board's program ended at frame {self.frames}")
            if not ready:
                return None
            got += more
        return got[2:-2] if got == _framed(got[2:-2]) else None

    def _stop(self) -> None:
        """End the process."""
        self.process.kill()
        self.process.communicate()


@dataclasses.dataclass(frozen=True)
class BoardTest:
    """What an exported controller did on a board beside what onnxruntime did in Python, from the same seeds."""

    on_board: list[Episode]
    """Episodes with the board as the controller."""
    in_python: list[Episode]
    """The same with the policy in Python."""
    frames: int
    """Observations that were sent."""
    refused: int
    """Frames that the board refused."""
    unanswered: int
    """Frames without an answer."""
    rate: float
    """Exchanges a second, with the simulation between them."""

    @property
    def returns(self) -> np.ndarray:
        """Returns on the board and in Python, shape (episodes, 2)."""
        return np.array(
            [[one.reward.sum() for one in pair] for pair in zip(self.on_board, self.in_python, strict=True)]
        )

    @property
    def alike(self) -> int:
        """Episodes whose return is within 1 % of Python's."""
        board, python = self.returns.T
        return int((np.abs(board - python) <= 0.01 * np.abs(python)).sum())


def board_test(
    folder: Path,
    target: str = "host",
    episodes: int = 20,
    seed: int = 0,
    lost: float = 0.0,
    damaged: float = 0.0,
    on_step: Callable[[int, int], None] | None = None,
) -> BoardTest:
    """Run the exported C as the controller of the simulation, and the exported ONNX model beside it.

    Args:
        folder: what `codrl_mj.deploy.export` wrote.
        target: `host`, or `cortex-m4f`, which QEMU emulates.
        episodes: how many, each from its own seed.
        seed: of the first of them.
        lost: share of the frames that never arrive at the board.
        damaged: share of them in which a bit has flipped.
        on_step: called with (episodes running, episodes finished) after every step on the board.

    Raises:
        FileNotFoundError: the folder has no contract or no C.
        ValueError: an argument is out of bounds.
        RuntimeError: a tool is missing (the message installs it), or the C does not compile.
    """
    with Board(folder, target, lost, damaged, seed) as board:
        env = EnvConfig.from_mapping(board.contract.assumed)
        began = time.perf_counter()
        on_board = run_episodes(board, env.make, episodes, seed, on_step=on_step)
        rate = board.frames / (time.perf_counter() - began)
        counts = board.frames, board.refused, board.unanswered
    return BoardTest(on_board, run_episodes(OnnxPolicy(folder), env.make, episodes, seed), *counts, rate)


def _build(folder: Path, target: str, built: Path) -> list[str]:
    """The command that runs the controller of a folder, compiled into another."""
    sources = [str(folder / name) for name in SOURCES]
    if gone := [name for name in (*sources, str(folder / "controller.h")) if not Path(name).is_file()]:
        raise FileNotFoundError(f"{gone[0]}: missing: write the folder with codrl-mj export")
    program = str(built / "controller")
    command = ["cc", *_STRICT, *sources, "-lm", "-o", program]
    if target == "cortex-m4f":
        linked = ["-T", str(folder / "board.ld"), *sources, "-lm", "-o", program]
        command = ["arm-none-eabi-gcc", *_CORTEX.split(), *_STRICT, *linked]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        said = next((line for line in done.stderr.splitlines() if "error" in line), done.stderr.strip())
        raise RuntimeError(f"{folder}: its C does not compile: {said}")
    return [program] if target == "host" else [*_QEMU.split(), "enable=on,target=native", "-kernel", program]


def _framed(content: bytes) -> bytes:
    """A frame of the wire: its start, what it says, and their checksum (CRC-16/CCITT, from 0xFFFF)."""
    return _START + content + struct.pack("<H", binascii.crc_hqx(content, 0xFFFF))
