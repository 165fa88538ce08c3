"""`codrl-mj board`: what was exported, as a controller."""

import dataclasses
from pathlib import Path
from typing import Annotated

import tyro


@dataclasses.dataclass(frozen=True)
class Test:
    """Run the exported C as the controller of the simulation, frame by frame, and the ONNX model beside it.

    The C is compiled for this machine, or for a Cortex-M4F that QEMU emulates. The status is 1 where fewer than 95 % of
    the returns are within 1 % of Python's, and no frame was spoilt on purpose.

    Example: codrl-mj board test furuta --target cortex-m4f
    """

    folder: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FOLDER", help="What export wrote.")]
    target: str = "host"
    """Where the C runs: host, or cortex-m4f."""
    episodes: int = 20
    """Episodes, each from its own seed."""
    seed: int = 0
    """Seed of the first of them."""
    lost: float = 0.0
    """Share of the frames that never arrive at the board."""
    damaged: float = 0.0
    """Share of the frames in which a bit flips on the way."""
    log: Path | None = None
    """CSV file for what the board saw and did in the first episode; `board check` reads it."""

    def run(self) -> int:
        """Run the episodes and print a table."""
        from codrl_mj.cli.terminal import print_table, progress_bar, say
        from codrl_mj.deploy import Contract, board_test, write_log
        from codrl_mj.runs.files import check_file

        if self.log is not None:
            check_file(self.log)
        with progress_bar("{task.completed}/{task.total} episodes") as bar:
            row = bar.add_task(f"on {self.target}", total=self.episodes)
            given = self.folder, self.target, self.episodes, self.seed, self.lost, self.damaged
            done = board_test(*given, on_step=lambda _, ended: bar.update(row, completed=ended))
        board, python = done.returns.mean(axis=0)
        rows = [
            ("return on the board, mean", f"{board:.6g}"),
            ("return in Python, mean", f"{python:.6g}"),
            ("episodes within 1 %", f"{done.alike} of {self.episodes}"),
            ("frames: sent, refused, without an answer", f"{done.frames}, {done.refused}, {done.unanswered}"),
            ("frames a second, with the simulation", f"{done.rate:.0f}"),
        ]
        print_table(f"{self.folder} as C on {self.target}", ("", ""), rows)
        if self.log is not None:
            write_log(self.log, Contract.read(self.folder), done.on_board[0])
            say(f"wrote {self.log}; try: codrl-mj board check {self.folder} {self.log}")
        return int(done.alike < 0.95 * self.episodes and self.lost == self.damaged == 0.0)


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
class BoardTools:
    """An exported policy as a controller: run its C in the loop with the simulation, or check what a rig recorded.

    Example: codrl-mj board test furuta
    """

    verb: tyro.conf.OmitSubcommandPrefixes[
        Annotated[Test, tyro.conf.subcommand("test")] | Annotated[CheckLog, tyro.conf.subcommand("check")]
    ]
    """What to do; each has its own --help."""

    def run(self) -> int:
        """Do it."""
        return self.verb.run()
