"""`codrl-mj board`: what was exported, as a controller."""

import dataclasses
import math
from pathlib import Path
from typing import Annotated

import tyro


@dataclasses.dataclass(frozen=True)
class Test:
    """Run the exported C as the controller of the simulation, frame by frame, and the ONNX model beside it.

    The C is compiled for this machine, or for a Cortex-M4F that QEMU emulates. The status is 1 where fewer than 95 % of
    the returns are within 1 % of Python's, unless frames are spoilt or the motor is another on purpose.

    Example: codrl-mj board test furuta --target cortex-m4f
    """

    folder: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FOLDER", help="What export wrote.")]
    target: str = "host"
    """Where the C runs: host, or cortex-m4f."""
    episodes: int = 20
    """Episodes, each from its own seed."""
    seed: int = 0
    """Seed of the first of them."""
    loop: bool = True
    """Let the C close the motors' current loop too, sample by sample, where it has one."""
    actuator: str | None = None
    """Motor in the simulation, by name or file, where it is to be another than the policy's."""
    lost: float = 0.0
    """Share of the frames that never arrive at the board."""
    damaged: float = 0.0
    """Share of the frames in which a bit flips on the way."""
    late: float = 0.0
    """Share of the answers that come a period late: the command before holds."""
    counts: int = 0
    """Steps of the encoders in a turn, such as 2048; 0: exact."""
    current_bits: int = 0
    """Bits of the converter that measures the current, such as 12; 0: exact."""
    pwm_bits: int = 0
    """Bits of the bridge's voltages; 0: exact."""
    film: Path | None = None
    """Film of the first episode with the board as the controller: .mp4 or .gif."""
    log: Path | None = None
    """CSV file for what the board saw and did in the first episode; `board check` reads it."""

    def run(self) -> int:
        """Run the episodes and print a table."""
        from codrl_mj.cli.terminal import print_table, progress_bar
        from codrl_mj.deploy import Board, Contract, Link, board_test, write_log
        from codrl_mj.runs.files import check_file

        if self.log is not None:
            check_file(self.log)
        if self.film is not None:
            from codrl_mj.films.film import check_film

            check_film(self.film, 640, 480)
        names = ("lost", "damaged", "late", "counts", "current_bits", "pwm_bits")
        link = Link(**{name: getattr(self, name) for name in names})
        with progress_bar("{task.completed}/{task.total} episodes") as bar:
            row = bar.add_task(f"on {self.target}", total=self.episodes)
            given = self.folder, self.target, self.episodes, self.seed, link, self.loop, self.actuator
            done = board_test(*given, on_step=lambda _, ended: bar.update(row, completed=ended))
        board, python = done.returns.mean(axis=0)
        taken = "not counted here" if done.instructions is None else "{} and {}".format(*done.instructions)
        rows = [
            ("return on the board, mean", f"{board:.6g}"),
            ("return in Python, mean", f"{python:.6g}"),
            ("episodes within 1 %", f"{done.alike} of {self.episodes}"),
            ("frames: sent, refused, without an answer", f"{done.frames}, {done.refused}, {done.unanswered}"),
            ("observations beyond the limits", f"{done.stopped}"),
            ("samples of the current loop", f"{done.samples or 'none: the simulation closes it'}"),
            ("frames and samples a second", f"{done.rate:.0f}"),
            ("instructions of a policy step, a sample", taken),
        ]
        print_table(f"{self.folder} as C on {self.target}", ("", ""), rows)
        if self.log is not None:
            write_log(self.log, Contract.read(self.folder), done.on_board[0])
            print(f"wrote {self.log}; try: codrl-mj board check {self.folder} {self.log}")
        if self.film is not None:
            from codrl_mj.films.film import film, record

            with Board(self.folder, self.target, link, self.seed, self.loop, self.actuator) as driving:
                env = driving.rig
                panel = record(driving, env, self.seed, 640, 480)
            title = f"{env.task} by its C on {self.target}: return {panel.episode.total:.0f}"
            film([dataclasses.replace(panel, title=title)], self.film, 640, 480)
            print(f"wrote {self.film}")
        return int(done.alike < 0.95 * self.episodes and link == Link() and self.actuator is None)


@dataclasses.dataclass(frozen=True)
class CheckLog:
    """Hold a log of a controller against the contract: names, order, units, rate, ranges, and every command.

    The log has comma-separated columns `name:unit`: time:s, the observations in their order, the commands. The status
    is 1 where commands are not the policy's, or came late.

    Example: codrl-mj board check furuta swing.csv
    """

    folder: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FOLDER", help="What export wrote.")]
    log: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="LOG.csv", help="What the controller recorded.")]

    def run(self) -> int:
        """Check it and print a table."""
        from codrl_mj.cli.terminal import print_table
        from codrl_mj.deploy import check_log

        found = check_log(self.folder, self.log)
        outside = ", ".join(f"{name} in {count}" for name, count in found.outside.items() if count)
        rows = [
            ("rows; rate", f"{found.rows}; {found.rate:.4g} Hz"),
            ("came late", str(found.late)),
            ("outside of what the policy saw", outside or "none"),
            ("commands that are not the policy's", f"{found.differing}, by {found.worst:.2g} at most"),
        ]
        print_table(f"{self.log} by the contract of {self.folder}", ("", ""), rows)
        return int(found.differing > 0 or found.late > 0)


@dataclasses.dataclass(frozen=True)
class RunBoard:
    """Watch a real board at a serial port, or tell it to drive, and log what it says, until any key.

    It watches unless told to --drive: the board says its observations and which commands it would give. A motor moves
    only with --drive, which ends by itself when something is wrong, and always ends with the command for safety.

    Example: codrl-mj board run furuta --port /dev/ttyACM0 --out swing.csv
    """

    folder: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FOLDER", help="What export wrote.")]
    port: str
    """Serial port, such as /dev/ttyACM0."""
    out: Path
    """CSV file for what it says: `board check` and `identify` read it."""
    drive: bool = False
    """Let the board give its commands to the motor."""
    seconds: float = math.inf
    """How long at most."""
    baud: int = 115_200
    """Bits a second."""

    def run(self) -> int:
        """Run until a key, and say how it went."""
        from codrl_mj.cli.terminal import any_key, print_table, say
        from codrl_mj.deploy import run_board

        say(f"{'DRIVES' if self.drive else 'watches'} {self.port}; any key ends it")
        with any_key() as pressed:
            given = self.folder, self.port, self.out, self.drive, self.seconds, self.baud
            done = run_board(*given, ended=pressed)
        rows = [
            ("ended", done.why),
            ("rows; frames without an answer; late", f"{done.rows}; {done.missed}; {done.late}"),
        ]
        print_table(f"{self.folder} on {self.port}", ("", ""), rows)
        print(f"wrote {self.out}; try: codrl-mj board check {self.folder} {self.out}")
        return int(done.why != "told to")
