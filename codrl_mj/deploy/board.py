"""The exported C as the controller of the simulation: compiled, run here or on an emulated board, asked over a wire."""

import contextlib
import dataclasses
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from codrl_mj.deploy.contract import Contract
from codrl_mj.deploy.wire import BEYOND, REFUSED, Wire
from codrl_mj.envs.config import EnvConfig
from codrl_mj.evaluation import Episode, run_episodes
from codrl_mj.fields import Checked, check_names, integer, real

SOURCES = ("controller.c", "wire.c", "board.c")
_STRICT = ["-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-Wconversion"]
_CORTEX = (
    "-mcpu=cortex-m4 -mthumb -mfloat-abi=hard -mfpu=fpv4-sp-d16 -ffreestanding -nostartfiles"
    " -DBOARD_SEMIHOSTING"
)
_QEMU = "qemu-system-arm -M mps2-an386 -display none -monitor none -serial none -semihosting-config"
TARGETS = {  # name -> what it needs: program -> the package of Debian's that has it
    "host": {"cc": "gcc"},
    "cortex-m4f": {
        "arm-none-eabi-gcc": "gcc-arm-none-eabi libnewlib-arm-none-eabi",
        "qemu-system-arm": "qemu-system-arm",
    },
}
NANOSECONDS = 64
"""Of an emulated instruction, of which QEMU makes only powers of two, where instructions are counted."""
_TICK = 40  # ns, of the emulated board's clock


def missing_tools(target: str) -> str:
    """What installs the tools that a target lacks; empty where it lacks none. An unknown target is refused."""
    check_names([target], TARGETS, "target")
    lacking = [package for program, package in TARGETS[target].items() if not shutil.which(program)]
    return f"apt-get install {' '.join(lacking)}" if lacking else ""


class OnnxPolicy:
    """The policy of an exported folder by onnxruntime, chosen as other policies are; within the contract's limits."""

    def __init__(self, folder: Path) -> None:
        """Load what `codrl_mj.deploy.export` wrote into a folder."""
        import onnxruntime

        self.session = onnxruntime.InferenceSession(
            folder / "policy.onnx", providers=["CPUExecutionProvider"]
        )
        self.contract = Contract.read(folder)

    def predict(
        self,
        observation: np.ndarray,
        *,
        deterministic: bool = True,  # noqa: ARG002 - the protocol's
    ) -> tuple[np.ndarray, Any]:
        """Actions (N, m) or (N,) for observations (N, k)."""
        actions = self.session.run(None, {"observation": observation.astype(np.float32)})[0]
        beyond = ~self.contract.within(observation)
        if beyond.any():
            actions[beyond] = self.contract.actions_of(np.array([self.contract.late["command"]]))[0]
        return actions, None


@dataclasses.dataclass(frozen=True)
class Link(Checked):
    """What stands between a board and what it controls; nothing unless something is said.

    Raises:
        ValueError: a field is out of bounds.
    """

    lost: float = real(0.0, minimum=0.0, maximum=1.0)
    """Share of the frames that never arrive at the board."""
    damaged: float = real(0.0, minimum=0.0, maximum=1.0)
    """Share of the frames in which a bit flips on the way."""
    late: float = real(0.0, minimum=0.0, maximum=1.0)
    """Share of the answers that come a period late: the command before holds."""
    counts: int = integer(0, minimum=0)
    """Steps of the encoders in a turn, in which observed angles come; speeds [rad/s] come as
    differences of them over a period. 0: exact.
    """
    current_bits: int = integer(0, minimum=0)
    """Bits of the converter that measures the current, over the drive's range both ways. 0: exact."""
    pwm_bits: int = integer(0, minimum=0)
    """Bits of the bridge's voltages, which a current loop or the policy itself commands, over the
    supply both ways. 0: exact.
    """

    def encoded(self, contract: Contract, observation: np.ndarray) -> np.ndarray:
        """An observation (k,) as encoders with so many counts say it."""
        if not self.counts:
            return observation
        seen, step = np.array(observation, np.float64), 2.0 * np.pi / self.counts
        for place, one in enumerate(contract.observations):
            size = {"rad": step, "rad/s": step * contract.rate}.get(one["unit"] or "")
            if size:
                seen[place] = size * np.round(seen[place] / size)
            elif one["name"].startswith("cos_"):  # the sine follows it
                angle = step * np.round(np.arctan2(seen[place + 1], seen[place]) / step)
                seen[place : place + 2] = np.cos(angle), np.sin(angle)
        return seen


class Board(contextlib.AbstractContextManager["Board"]):
    """A policy that is computed by the exported C, in a process of its own, and asked frame by frame in lock step.

    A context manager: the process ends with it. Where no answer comes, the contract's command for
    safety is taken. While it is open, motors of this process ask another, of the same C, for the
    voltage of each sample of their loop.
    """

    def __init__(
        self,
        folder: Path,
        target: str = "host",
        link: Link | None = None,
        seed: int = 0,
        loop: bool = True,
        actuator: Any = None,
        trust: bool = False,
    ) -> None:
        """Compile the C and start it.

        Args:
            folder: what `codrl_mj.deploy.export` wrote.
            target: `host`, or `cortex-m4f`, which QEMU emulates.
            link: what stands between; None for nothing.
            seed: of what is lost, damaged and late.
            loop: whether the C closes the current loop too, where it has one; else the simulation
                does.
            actuator: what the simulation has for motors, by name, file or object; None: those of
                the training.
            trust: whether to import the modules that the contract names as task or actuator, which
                executes them.

        Raises:
            FileNotFoundError: the folder has no contract or no C.
            ValueError: the target or actuator is unknown, the actuator is of another family than
                the C's loop, the contract names a module and `trust` is false, or bits are given
                where the C neither closes a loop nor commands a voltage, or has no limit for them.
            RuntimeError: a tool is missing (the message installs it), or the C does not compile.
        """
        if install := missing_tools(target):
            raise RuntimeError(f"target {target}: its tools are missing: {install}")
        self.contract, self.link = Contract.read(folder), link or Link()
        self.random = np.random.default_rng(seed)
        self.frames, self.refused, self.stopped, self.unanswered = 0, 0, 0, 0
        self._safe = self._last = np.array(self.contract.late["command"])
        self.loop = self.contract.controller["loop"] if loop else None
        self.env = self.contract.environment(trust)
        trained = type(self.env.actuators[0])
        if actuator is not None:
            self.env = dataclasses.replace(
                self.env, actuator=dict.fromkeys(self.env.driven, actuator), randomize=None
            )
        motor: Any = self.env.actuators[0]
        if self.loop is not None and type(motor) is not trained:
            raise ValueError(
                f"actuator: a {type(motor).__name__}, must be a {trained.__name__}, for which the C"
                " closes the loop; or let the simulation close it (--no-loop)"
            )
        self.rig = (
            self.env
        )  # where the drive's limit of the current is the C's, which knows its own motor alone
        if self.loop is not None and actuator is not None and self.loop["kind"] == "sampled":
            unlimited = motor.replaced({"controller.max_current": np.inf})
            self.rig = dataclasses.replace(
                self.env, actuator=dict.fromkeys(self.env.driven, unlimited)
            )
        steps = self._converters()
        with contextlib.ExitStack() as held:
            process = held.enter_context(_running(folder, target))
            self._wire = Wire(self.contract, process.stdin.fileno(), process.stdout.fileno())
            self._samples = np.zeros(2)
            if self.loop is not None:
                from codrl_mj.deploy.on_board import loop_on_board

                amperes = (
                    motor.arm_radius / motor.motor.torque_constant
                    if self.env.action == "force"
                    else 1.0
                )
                drive = held.enter_context(_running(folder, target, "BOARD_DRIVE"))
                self._samples = held.enter_context(loop_on_board(trained, drive, amperes, *steps))
            self._held = held.pop_all()

    def __exit__(self, *_: object) -> None:
        self._held.close()

    @property
    def samples(self) -> int:
        """Samples of the current loop that the board computed."""
        return int(self._samples[0])

    def episodes(
        self, count: int, seed: int = 0, on_episode: Callable[[int], None] = lambda _: None
    ) -> list[Episode]:
        """Whole episodes, one after another: a late answer leaves the command before, which is an episode's own.

        Args:
            count: how many.
            seed: that of the first; each of the others has the next one.
            on_episode: called with how many are finished.

        Raises:
            ValueError: `seed` is below 0.
        """
        done: list[Episode] = []
        for place in range(count):
            self._last = self._safe
            done += run_episodes(self, self.rig.make, 1, seed + place)
            on_episode(len(done))
        return done

    def predict(
        self,
        observation: np.ndarray,
        *,
        deterministic: bool = True,  # noqa: ARG002 - the protocol's
    ) -> tuple[np.ndarray, Any]:
        """Actions (N, m) or (N,) for observations (N, k), each asked of the board in a frame of its own."""
        if self._samples[1]:
            raise RuntimeError(f"the board's current loop did not answer at sample {self.samples}")
        return self.contract.actions_of(np.array([self.command(row) for row in observation])), None

    def command(self, observation: np.ndarray) -> np.ndarray:
        """The command for an observation, in the units of the contract; that for safety if no good answer comes."""
        self.frames += 1
        observation = self.link.encoded(self.contract, observation)
        frame = bytearray(
            self._wire.frame(
                self.frames, self.frames * round(1e6 / self.contract.rate), observation
            )
        )
        if self.random.random() < self.link.lost:
            self.unanswered += 1
            return self._safe
        if self.random.random() < self.link.damaged:
            bit = int(
                self.random.integers(16, 8 * len(frame))
            )  # its start is found again in any case
            frame[bit // 8] ^= 1 << bit % 8
        answer = self._wire.asked(bytes(frame), self.frames)
        if answer is None:
            self.unanswered += 1
            return self._safe
        self.refused += bool(answer.status & REFUSED)
        self.stopped += bool(answer.status & BEYOND)
        command, self._last = (
            (self._last, answer.command)
            if self.random.random() < self.link.late
            else (answer.command,) * 2
        )
        return command

    def _converters(self) -> tuple[float, float]:
        """Steps of the measured current [A] and of the voltage [V] of a loop that the C closes."""
        bits = self.link.current_bits, self.link.pwm_bits
        if not any(bits):
            return 0.0, 0.0
        if self.loop is None:
            self.rig = self._with_bridge()
            return 0.0, 0.0
        voltage = self.loop["voltage"]
        if voltage is None:
            raise ValueError(
                "current_bits, pwm_bits: must be 0 where the drive's voltage has no limit"
            )
        resistance, _ = self.env.actuators[0].winding or (1.0, 0.0)
        ranges = self.loop["most"] or voltage / resistance, voltage
        return tuple(
            2.0 * most / 2**bit if bit else 0.0 for most, bit in zip(ranges, bits, strict=True)
        )  # type: ignore[return-value]

    def _with_bridge(self) -> EnvConfig:
        """Return the environment with a bridge of `pwm_bits` behind a policy that commands the voltages itself."""
        motor, disturbances, link = self.env.actuators[0], self.env.disturbances, self.link
        refusals = {
            "the simulation closes the current loop: leave --no-loop out": (
                self.contract.controller["loop"] is not None
            ),
            "the C neither closes a current loop nor commands a voltage": (
                self.env.action != "voltage"
            ),
            "the policy commands voltages, and the C measures no current": link.current_bits > 0,
            "the motors differ": any(one != motor for one in self.env.actuators),
            "the environment has a disturbances.command_quantum already": (
                disturbances.command_quantum > 0.0
            ),
        }
        for reason in (text for text, applies in refusals.items() if applies):
            raise ValueError(
                f"current_bits = {link.current_bits}, pwm_bits = {link.pwm_bits}: must be 0:"
                f" {reason}"
            )
        command = motor.commands()["voltage"]
        step = 2.0 * float(command.limit or 0.0) / 2**link.pwm_bits
        quantum = step * command.torque_per_unit / command.actuator.arm_radius
        return dataclasses.replace(
            self.env, disturbances=dataclasses.replace(disturbances, command_quantum=quantum)
        )


@dataclasses.dataclass(frozen=True)
class BoardTest:
    """What an exported controller did on a board beside what onnxruntime did in Python, from the same seeds."""

    on_board: list[Episode]
    """Episodes with the board as the controller."""
    in_python: list[Episode]
    """The same with the policy, and the current loop, in Python."""
    frames: int
    """Observations that were sent."""
    samples: int
    """Samples of the current loop that the board computed."""
    refused: int
    """Frames that the board refused."""
    stopped: int
    """Observations beyond the limits."""
    unanswered: int
    """Frames without an answer."""
    rate: float
    """Exchanges a second, frames and samples, with the simulation between them."""
    instructions: tuple[int, int] | None
    """Most of a policy step and of a current step, of the golden observations; None where they are not counted."""

    @property
    def returns(self) -> np.ndarray:
        """Returns on the board and in Python, shape (episodes, 2)."""
        return np.array(
            [
                [one.reward.sum() for one in pair]
                for pair in zip(self.on_board, self.in_python, strict=True)
            ]
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
    link: Link | None = None,
    loop: bool = True,
    actuator: Any = None,
    on_episode: Callable[[int], None] = lambda _: None,
    trust: bool = False,
) -> BoardTest:
    """Run the exported C as the controller of the simulation, and the exported ONNX model beside it.

    Args:
        folder: what `codrl_mj.deploy.export` wrote.
        target: `host`, or `cortex-m4f`, which QEMU emulates.
        episodes: how many, each from its own seed.
        seed: of the first of them.
        link: what stands between board and simulation; None for nothing.
        loop: whether the C closes the current loop too, where it has one.
        actuator: as for `Board`.
        on_episode: called with how many are finished on the board.
        trust: as for `Board`.

    Raises:
        FileNotFoundError: the folder has no contract or no C.
        ValueError: an argument is out of bounds.
        RuntimeError: a tool is missing (the message installs it), or the C does not compile.
    """
    with Board(folder, target, link, seed, loop, actuator, trust) as board:
        env = board.env
        began = time.perf_counter()
        on_board = board.episodes(episodes, seed, on_episode)
        rate = (board.frames + board.samples) / (time.perf_counter() - began)
        counts = board.frames, board.samples, board.refused, board.stopped, board.unanswered
    in_python = run_episodes(OnnxPolicy(folder), env.make, episodes, seed)
    return BoardTest(
        on_board, in_python, *counts, rate, instructions(folder) if target == "cortex-m4f" else None
    )


def instructions(folder: Path) -> tuple[int, int]:
    """Most instructions of a policy step and of a current step on an emulated Cortex-M4F, of the golden observations.

    Raises:
        FileNotFoundError: the folder has no contract or no C.
        RuntimeError: a tool is missing (the message installs it), or the C does not compile.
    """
    contract = Contract.read(folder)
    rows = np.array(
        contract.golden["observations"], "<f8" if contract.controller["real"] == "double" else "<f4"
    )
    with _running(folder, "cortex-m4f", "BOARD_TICKS") as process:
        got = process.communicate(rows.tobytes(), timeout=60)[0]
    most = np.frombuffer(got, "<u4").reshape(len(rows), 2).max(axis=0) * _TICK / NANOSECONDS
    return int(most[0]), int(most[1])


@contextlib.contextmanager
def _running(folder: Path, target: str, define: str = "") -> Iterator[Any]:
    """The program of a folder, compiled and running, with pipes."""
    with tempfile.TemporaryDirectory() as built:
        command = _build(folder, target, Path(built), [f"-D{define}"] if define else [])
        counted = (
            ["-icount", f"shift={NANOSECONDS.bit_length() - 1}"] if define == "BOARD_TICKS" else []
        )
        process = subprocess.Popen(
            [*command, *counted], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )
        try:
            yield process
        finally:
            process.kill()
            with contextlib.suppress(ValueError):  # its pipes are closed
                process.communicate()


def _build(folder: Path, target: str, built: Path, flags: list[str]) -> list[str]:
    """The command that runs the controller of a folder, compiled into another."""
    sources = [
        str(folder / name) for name in SOURCES if not flags or name != "wire.c"
    ]  # frames, or samples
    if gone := [
        name for name in (*sources, str(folder / "controller.h")) if not Path(name).is_file()
    ]:
        raise FileNotFoundError(f"{gone[0]}: missing: write the folder with codrl-mj export")
    program = str(built / "controller")
    command = ["cc", *_STRICT, *flags, *sources, "-lm", "-o", program]
    if target == "cortex-m4f":
        linked = ["-T", str(folder / "board.ld"), *sources, "-lm", "-o", program]
        command = ["arm-none-eabi-gcc", *_CORTEX.split(), *_STRICT, *flags, *linked]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        lines = done.stderr.splitlines()
        said = next(
            (line for line in lines if "error:" in line or "undefined" in line), done.stderr.strip()
        )
        raise RuntimeError(f"{folder}: its C does not compile: {said}")
    return (
        [program]
        if target == "host"
        else [*_QEMU.split(), "enable=on,target=native", "-kernel", program]
    )
