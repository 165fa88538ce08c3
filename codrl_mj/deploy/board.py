"""Processor-in-the-loop test of the exported C code, on the host or on an emulated board.

The C code is the controller of the simulation and communicates with it frame by frame.
"""

import contextlib
import dataclasses
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import cast

import numpy as np

from codrl_mj.actuators import DCMotorActuator, Drive
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
# Target -> required program -> Debian packages that install it.
TARGETS = {
    "host": {"cc": "gcc"},
    "cortex-m4f": {
        "arm-none-eabi-gcc": "gcc-arm-none-eabi libnewlib-arm-none-eabi",
        "qemu-system-arm": "qemu-system-arm",
    },
}
NANOSECONDS = 64
"""Duration of an emulated instruction while instructions are counted; QEMU has only powers of 2."""
_TICK = 40
"""Period of the emulated board's clock [ns]."""


def missing_tools(target: str) -> str:
    """Return the command that installs a target's missing tools; "" if none is missing.

    Raises:
        ValueError: the target is unknown.
    """
    check_names([target], TARGETS, "target")
    missing = [package for program, package in TARGETS[target].items() if not shutil.which(program)]
    return f"apt-get install {' '.join(missing)}" if missing else ""


class OnnxPolicy:
    """The ONNX policy of an exported folder, with the safe command beyond the contract's limits.

    It has the interface of the other policies; onnxruntime computes it.
    """

    def __init__(self, folder: Path) -> None:
        """Load the policy from a folder that `codrl_mj.deploy.export` wrote."""
        # onnxruntime is optional.
        import onnxruntime

        self.session = onnxruntime.InferenceSession(
            folder / "policy.onnx", providers=["CPUExecutionProvider"]
        )
        self.contract = Contract.read(folder)

    def predict(
        self,
        observation: np.ndarray,
        *,
        deterministic: bool = True,  # noqa: ARG002 - required by the Policy protocol
    ) -> tuple[np.ndarray, None]:
        """Return actions (N, m) or (N,) for observations (N, k)."""
        actions = self.session.run(None, {"observation": observation.astype(np.float32)})[0]
        is_beyond = ~self.contract.is_within_limits(observation)
        if is_beyond.any():
            actions[is_beyond] = self.contract.to_actions(
                np.array([self.contract.late["command"]])
            )[0]
        return actions, None


@dataclasses.dataclass(frozen=True)
class Link(Checked):
    """Imperfections of the connection between a board and the controlled system; none by default.

    Raises:
        ValueError: a field is out of bounds.
    """

    lost: float = real(0.0, minimum=0.0, maximum=1.0)
    """Share of the frames that do not arrive at the board."""
    damaged: float = real(0.0, minimum=0.0, maximum=1.0)
    """Share of the frames in which one bit flips."""
    late: float = real(0.0, minimum=0.0, maximum=1.0)
    """Share of the answers that come one period late, so that the previous command is held."""
    counts: int = integer(0, minimum=0)
    """Encoder counts per turn, to which angles are rounded; 0: exact.

    Speeds [rad/s] are rounded to one count per period.
    """
    current_bits: int = integer(0, minimum=0)
    """Bits of the current measurement, over the drive's range in both directions; 0: exact."""
    pwm_bits: int = integer(0, minimum=0)
    """Bits of the bridge's voltage, over the supply voltage in both directions; 0: exact.

    A current loop, or the policy itself, commands the voltage.
    """

    def quantize(self, contract: Contract, observation: np.ndarray) -> np.ndarray:
        """Return an observation (k,) as encoders with `counts` per turn measure it."""
        if not self.counts:
            return observation
        measured, step = np.array(observation, np.float64), 2.0 * np.pi / self.counts
        for index, entry in enumerate(contract.observations):
            size = {"rad": step, "rad/s": step * contract.rate}.get(entry["unit"] or "")
            if size:
                measured[index] = size * np.round(measured[index] / size)
            # The sine of an angle follows its cosine.
            elif entry["name"].startswith("cos_"):
                angle = step * np.round(np.arctan2(measured[index + 1], measured[index]) / step)
                measured[index : index + 2] = np.cos(angle), np.sin(angle)
        return measured


class Board(contextlib.AbstractContextManager["Board"]):
    """A policy that the exported C code computes in a separate process, frame by frame.

    As a context manager it terminates the process at the end. If an answer is missing, the
    contract's safe command is used. If the C code also closes the current loop, the simulated
    motors request the voltage of each sample from a second process that runs the same code.
    """

    def __init__(
        self,
        folder: Path,
        target: str = "host",
        link: Link | None = None,
        seed: int = 0,
        loop: bool = True,
        actuator: object = None,
        trust: bool = False,
    ) -> None:
        """Compile and start the C code.

        Args:
            folder: a folder that `codrl_mj.deploy.export` wrote.
            target: `host`, or `cortex-m4f`, which QEMU emulates.
            link: imperfections of the connection; None for none.
            seed: seed of lost, damaged and late frames.
            loop: True if the C code also closes the current loop, if it has one; False if the
                simulation closes it.
            actuator: motors of the simulation, by name, file or object; None: those of the
                training.
            trust: True to import the modules that the contract names as task or actuator, which
                executes their code.

        Raises:
            FileNotFoundError: the folder has no contract or no C code.
            ValueError: the target or actuator is unknown, the actuator is of another family than
                the loop in the C code, the contract names a module and `trust` is false, or
                `current_bits` or `pwm_bits` are set although the C code neither closes a loop nor
                commands a voltage, or has no limit that gives their range.
            RuntimeError: a tool is missing (the message says how to install it), or the C code does
                not compile.
        """
        if install := missing_tools(target):
            raise RuntimeError(f"target {target}: its tools are missing: {install}")
        self.contract, self.link = Contract.read(folder), link or Link()
        self.random = np.random.default_rng(seed)
        self.frames, self.refused, self.beyond_limits, self.unanswered = 0, 0, 0, 0
        self._safe = self._last = np.array(self.contract.late["command"])
        self.loop = self.contract.controller["loop"] if loop else None
        self.env = self.contract.environment(trust)
        trained = type(self.env.actuators[0])
        if actuator is not None:
            self.env = dataclasses.replace(
                self.env,
                actuator=dict.fromkeys(self.env.actuators_by_name, actuator),
                randomize=None,
            )
        motor = self.env.actuators[0]
        if self.loop is not None and type(motor) is not trained:
            raise ValueError(
                f"actuator: a {type(motor).__name__}, must be a {trained.__name__}, for which the C"
                " code closes the loop; or let the simulation close it (--no-loop)"
            )
        # The C code applies the drive's current limit, computed for the motor of the training. A
        # different motor in the simulation must therefore have no limit.
        self.rig = self.env
        if self.loop is not None and actuator is not None and self.loop["kind"] == "sampled":
            unlimited = motor.replaced({"controller.max_current": np.inf})
            self.rig = dataclasses.replace(
                self.env, actuator=dict.fromkeys(self.env.actuators_by_name, unlimited)
            )
        steps = self._converters()
        with contextlib.ExitStack() as stack:
            process = stack.enter_context(_running(folder, target))
            assert process.stdin is not None
            assert process.stdout is not None
            self._wire = Wire(self.contract, process.stdin.fileno(), process.stdout.fileno())
            self._samples = np.zeros(2)
            if self.loop is not None:
                # The import compiles with numba and is only needed if the C code closes the loop.
                from codrl_mj.deploy.on_board import loop_on_board

                looped = cast(Drive | DCMotorActuator, motor)
                amperes = (
                    looped.arm_radius / looped.motor.torque_constant
                    if self.env.action == "force"
                    else 1.0
                )
                drive = stack.enter_context(_running(folder, target, "BOARD_DRIVE"))
                self._samples = stack.enter_context(loop_on_board(trained, drive, amperes, *steps))
            # Without an error so far, the processes stay open until `__exit__`.
            self._processes = stack.pop_all()

    def __exit__(self, *_: object) -> None:
        self._processes.close()

    @property
    def samples(self) -> int:
        """Number of samples of the current loop that the board computed."""
        return int(self._samples[0])

    def episodes(
        self, count: int, seed: int = 0, on_episode: Callable[[int], None] = lambda _: None
    ) -> list[Episode]:
        """Run whole episodes one after another.

        Args:
            count: number of episodes.
            seed: seed of the first episode; each of the others has the next seed.
            on_episode: callback with the number of finished episodes.

        Raises:
            ValueError: `seed` is below 0.
        """
        finished: list[Episode] = []
        for index in range(count):
            # A late answer must not apply a command of the previous episode.
            self._last = self._safe
            finished += run_episodes(self, self.rig.build, 1, seed + index)
            on_episode(len(finished))
        return finished

    def predict(
        self,
        observation: np.ndarray,
        *,
        deterministic: bool = True,  # noqa: ARG002 - required by the Policy protocol
    ) -> tuple[np.ndarray, None]:
        """Return actions (N, m) or (N,) for observations (N, k), each sent in a separate frame."""
        if self._samples[1]:
            raise RuntimeError(f"the board's current loop did not answer at sample {self.samples}")
        return self.contract.to_actions(np.array([self.command(row) for row in observation])), None

    def command(self, observation: np.ndarray) -> np.ndarray:
        """Return the command for an observation, in the contract's units.

        Without an answer it is the safe command.
        """
        self.frames += 1
        observation = self.link.quantize(self.contract, observation)
        frame = bytearray(
            self._wire.frame(
                self.frames, self.frames * round(1e6 / self.contract.rate), observation
            )
        )
        if self.random.random() < self.link.lost:
            self.unanswered += 1
            return self._safe
        if self.random.random() < self.link.damaged:
            # The two start bytes stay intact, so that the receiver finds the frame.
            bit = int(self.random.integers(16, 8 * len(frame)))
            frame[bit // 8] ^= 1 << bit % 8
        answer = self._wire.request(bytes(frame), self.frames)
        if answer is None:
            self.unanswered += 1
            return self._safe
        self.refused += bool(answer.status & REFUSED)
        self.beyond_limits += bool(answer.status & BEYOND)
        command, self._last = (
            (self._last, answer.command)
            if self.random.random() < self.link.late
            else (answer.command,) * 2
        )
        return command

    def _converters(self) -> tuple[float, float]:
        """Return the resolutions of current [A] and voltage [V] if the C code closes the loop."""
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
            2.0 * largest / 2**num_bits if num_bits else 0.0
            for largest, num_bits in zip(ranges, bits, strict=True)
        )  # type: ignore[return-value]

    def _with_bridge(self) -> EnvConfig:
        """Return the environment with a bridge of `pwm_bits` for policies that command voltages."""
        motor, disturbances, link = self.env.actuators[0], self.env.disturbances, self.link
        refusals = {
            "the simulation closes the current loop: leave --no-loop out": (
                self.contract.controller["loop"] is not None
            ),
            "the C code neither closes a current loop nor commands a voltage": (
                self.env.action != "voltage"
            ),
            "the policy commands voltages, and the C code measures no current": link.current_bits
            > 0,
            "the motors differ": any(actuator != motor for actuator in self.env.actuators),
            "the environment has a disturbances.command_quantum already": (
                disturbances.command_quantum > 0.0
            ),
        }
        for reason in (text for text, applies in refusals.items() if applies):
            raise ValueError(
                f"current_bits = {link.current_bits}, pwm_bits = {link.pwm_bits}: must be 0:"
                f" {reason}"
            )
        # The environment's quantum is in its units of force, so the voltage step is converted.
        command = motor.commands()["voltage"]
        step = 2.0 * float(command.limit or 0.0) / 2**link.pwm_bits
        quantum = step * command.torque_per_unit / command.actuator.arm_radius
        return dataclasses.replace(
            self.env, disturbances=dataclasses.replace(disturbances, command_quantum=quantum)
        )


@dataclasses.dataclass(frozen=True)
class BoardTest:
    """Results of an exported controller on a board, and of its ONNX model from the same seeds."""

    on_board: list[Episode]
    """Episodes with the board as the controller."""
    in_python: list[Episode]
    """Episodes with the policy and the current loop in Python."""
    frames: int
    """Number of observations sent to the board."""
    samples: int
    """Number of samples of the current loop that the board computed."""
    refused: int
    """Number of frames that the board refused."""
    beyond_limits: int
    """Number of observations beyond the limits."""
    unanswered: int
    """Number of frames without an answer."""
    rate: float
    """Exchanged frames plus samples per second [1/s]; the time includes that of the simulation."""
    instructions: tuple[int, int] | None
    """Largest instruction counts of a policy step and a current step; None if not counted."""

    @property
    def returns(self) -> np.ndarray:
        """Returns of the episodes on the board and in Python, shape (episodes, 2)."""
        return np.array(
            [
                [episode.reward.sum() for episode in pair]
                for pair in zip(self.on_board, self.in_python, strict=True)
            ]
        )

    @property
    def num_equal_returns(self) -> int:
        """Number of episodes whose return is within 1 % of Python's."""
        board, python = self.returns.T
        return int((np.abs(board - python) <= 0.01 * np.abs(python)).sum())


def board_test(
    folder: Path,
    target: str = "host",
    episodes: int = 20,
    seed: int = 0,
    link: Link | None = None,
    loop: bool = True,
    actuator: object = None,
    on_episode: Callable[[int], None] = lambda _: None,
    trust: bool = False,
) -> BoardTest:
    """Run episodes with the exported C code as the controller, and with the exported ONNX model.

    Args:
        folder: a folder that `codrl_mj.deploy.export` wrote.
        target: `host`, or `cortex-m4f`, which QEMU emulates.
        episodes: number of episodes, each with a different seed.
        seed: seed of the first episode.
        link: imperfections of the connection; None for none.
        loop: True if the C code also closes the current loop, if it has one.
        actuator: as for `Board`.
        on_episode: callback with the number of episodes finished on the board.
        trust: as for `Board`.

    Raises:
        FileNotFoundError: the folder has no contract or no C code.
        ValueError: an argument is out of bounds.
        RuntimeError: a tool is missing (the message says how to install it), or the C code does not
            compile.
    """
    with Board(folder, target, link, seed, loop, actuator, trust) as board:
        env = board.env
        start = time.perf_counter()
        on_board = board.episodes(episodes, seed, on_episode)
        rate = (board.frames + board.samples) / (time.perf_counter() - start)
        counts = board.frames, board.samples, board.refused, board.beyond_limits, board.unanswered
    in_python = run_episodes(OnnxPolicy(folder), env.build, episodes, seed)
    return BoardTest(
        on_board, in_python, *counts, rate, instructions(folder) if target == "cortex-m4f" else None
    )


def instructions(folder: Path) -> tuple[int, int]:
    """Return the largest instruction counts of a policy step and a current step on a Cortex-M4F.

    The maximum is over the golden observations; the processor is emulated.

    Raises:
        FileNotFoundError: the folder has no contract or no C code.
        RuntimeError: a tool is missing (the message says how to install it), or the C code does not
            compile.
    """
    contract = Contract.read(folder)
    rows = np.array(
        contract.golden["observations"], "<f8" if contract.controller["real"] == "double" else "<f4"
    )
    with _running(folder, "cortex-m4f", "BOARD_TICKS") as process:
        output = process.communicate(rows.tobytes(), timeout=60)[0]
    counts = np.frombuffer(output, "<u4").reshape(len(rows), 2).max(axis=0) * _TICK / NANOSECONDS
    return int(counts[0]), int(counts[1])


@contextlib.contextmanager
def _running(folder: Path, target: str, define: str = "") -> Iterator[subprocess.Popen[bytes]]:
    """Compile the program of a folder and run it with pipes during a `with` block."""
    with tempfile.TemporaryDirectory() as build_folder:
        command = _build(folder, target, Path(build_folder), [f"-D{define}"] if define else [])
        # QEMU then counts instructions instead of measuring time.
        icount_flags = (
            ["-icount", f"shift={NANOSECONDS.bit_length() - 1}"] if define == "BOARD_TICKS" else []
        )
        process = subprocess.Popen(
            [*command, *icount_flags], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )
        try:
            yield process
        finally:
            process.kill()
            # The pipes may have been closed already.
            with contextlib.suppress(ValueError):
                process.communicate()


def _build(folder: Path, target: str, build_folder: Path, flags: list[str]) -> list[str]:
    """Compile the controller of a folder and return the command that runs it.

    Args:
        folder: folder with the C files.
        target: name from `TARGETS`.
        build_folder: folder for the program.
        flags: compiler flags; programs with a flag exchange no frames and need no `wire.c`.
    """
    sources = [str(folder / name) for name in SOURCES if not flags or name != "wire.c"]
    if absent := [
        name for name in (*sources, str(folder / "controller.h")) if not Path(name).is_file()
    ]:
        raise FileNotFoundError(f"{absent[0]}: missing: write the folder with codrl-mj export")
    program = str(build_folder / "controller")
    command = ["cc", *_STRICT, *flags, *sources, "-lm", "-o", program]
    if target == "cortex-m4f":
        linker_arguments = ["-T", str(folder / "board.ld"), *sources, "-lm", "-o", program]
        command = ["arm-none-eabi-gcc", *_CORTEX.split(), *_STRICT, *flags, *linker_arguments]
    compiled = subprocess.run(command, capture_output=True, text=True, check=False)
    if compiled.returncode:
        lines = compiled.stderr.splitlines()
        # The first error; a linker's error says "undefined".
        error = next(
            (line for line in lines if "error:" in line or "undefined" in line),
            compiled.stderr.strip(),
        )
        raise RuntimeError(f"{folder}: its C code does not compile: {error}")
    return (
        [program]
        if target == "host"
        else [*_QEMU.split(), "enable=on,target=native", "-kernel", program]
    )
