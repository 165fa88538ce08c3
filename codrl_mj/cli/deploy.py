"""`codrl-mj export`, `board` and `identify compare`: a policy taken out, run on a board, and what a rig then did."""

import dataclasses
import math
from pathlib import Path
from typing import Annotated, Any

import tyro

from codrl_mj.actuators import family_name
from codrl_mj.cli.environments import AS_TRAINED, ActuatorName, environment, with_environment
from codrl_mj.cli.parsing import AsJson, Trust, named_numbers
from codrl_mj.cli.subject import Source, Subject
from codrl_mj.envs.config import EnvConfig
from codrl_mj.fields import command, differences

Exported = Annotated[
    tyro.conf.Positional[Path], tyro.conf.arg(metavar="FOLDER", help="What export wrote.")
]
"""Type of a verb's folder."""


@dataclasses.dataclass(frozen=True)
class Export:
    """Take a trained policy out of the simulator: as ONNX, as C99, and contract.json with all that it assumes.

    The contract has names, units, order and range of observations and actions, rate, actuator,
    delays, what to do when late, and 200 observations of episodes with the policy's actions, to be
    computed again elsewhere (docs/deploy.md).

    Example: codrl-mj export runs/furuta-ppo-ideal-0 --out furuta
    """

    run_folder: Annotated[
        tyro.conf.Positional[Path],
        tyro.conf.arg(
            metavar="RUN",
            help=(
                "Run folder; or a folder with a policy alone, or a Stable-Baselines3 zip, which"
                " take --task and what else they were trained with, such as --env.action voltage."
            ),
        ),
    ]
    source: tyro.conf.OmitArgPrefixes[Source] = Source()
    actuator_name: ActuatorName = AS_TRAINED
    out: Path = Path("exported")
    """Folder to write; it must not exist, or be empty."""
    episodes: int = 5
    """Episodes that are run for the contract's ranges and golden numbers."""
    seed: int = 0
    """Seed of the first of them."""
    float64: bool = False
    """Compute in double in the C, not in float."""
    limit: tuple[str, ...] = ()
    """Largest safe size of observations, as arm_velocity=30 arm=1.8: beyond, the command is that
    for safety. An angle that is observed as cos_arm and sin_arm is called arm.
    """
    board: str | None = None
    """What it is to fit: arduino-uno, arduino-due, nucleo-f446re, raspberry-pi-pico or teensy-4.1."""

    for_line = classmethod(with_environment)

    def run(self: Any) -> int:
        """Write the folder, and say what is in it."""
        from codrl_mj.cli.terminal import print_table
        from codrl_mj.deploy import export, network_of

        subject = self.source.load(self.run_folder)
        env = self._environment(subject)
        limits = named_numbers("--limit", self.limit, "arm_velocity=30")
        given = self.out, self.episodes, self.seed, self.float64, self.board, limits
        contract = export(subject.policy, env, subject.agent, *given)
        rows = [
            (side, one["name"], one.get("unit") or "?", _bounds(one))
            for side, several in (
                ("observation", contract.observations),
                ("action", contract.actions),
            )
            for one in several
        ]
        print_table(
            f"{contract.task}, {subject.agent}, {contract.rate:g} Hz",
            ("", "name", "unit", "range"),
            rows,
        )
        weights = network_of(subject.policy).size
        if contract.controller["loop"] is None and contract.actuators:
            why = (
                f"this policy commands a {env.action}"
                if env.action != "force"
                else "the motors differ, or have none"
            )
            print(f"no current loop: {why}")
        written = f"wrote {self.out}: policy.onnx, contract.json, controller.c ({weights} numbers)"
        names = env.task, *(family_name(type(one)) for one in env.actuators)
        print(
            f"{written}; try:"
            f" {command('board', 'test', self.out, trust=any(':' in name for name in names))}"
        )
        return 0

    def _environment(self: Any, subject: Subject) -> EnvConfig:
        """Return the environment of the training: a run says it itself, of a zip the flags do."""
        from codrl_mj.training.folder import load_config

        known = (
            subject.env
            if subject.run is None
            else load_config(subject.run, self.source.trust).evaluation_env
        )
        env = environment(self, subject.env.task, self.actuator_name, known)
        if subject.run is None:
            return env
        if other := differences(known.as_mapping(), env.as_mapping()):
            raise ValueError(
                f"{', '.join(other)}: {subject.run} says what it was trained in, and that is"
                " exported: leave the flags of the environment out; evaluate and board test take"
                " another --actuator"
            )
        return subject.env


def _bounds(entry: dict[str, Any]) -> str:
    if "levels" in entry:
        return f"one of {', '.join(f'{level:g}' for level in entry['levels'])}"
    least, most = entry.get("least"), entry.get("most")
    return "any" if least is None or most is None else f"{least:g} to {most:g}"


@dataclasses.dataclass(frozen=True)
class Test:
    """Run the exported C as the controller of the simulation, frame by frame, and the ONNX model beside it.

    The C is compiled for this machine, or for a Cortex-M4F that QEMU emulates. The status is 1
    where fewer than 95 % of the returns are within 1 % of Python's, unless frames are spoilt or the
    motor is another on purpose.

    Example: codrl-mj board test furuta --target cortex-m4f
    """

    folder: Exported
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
    trust: Trust = False

    def run(self) -> int:
        """Run the episodes and print a table."""
        from codrl_mj.cli.terminal import print_table, progress_bar
        from codrl_mj.deploy import Board, Contract, Link, board_test, write_log
        from codrl_mj.runs.files import check_file

        if self.log is not None:
            check_file(self.log)
        if self.film is not None:
            from codrl_mj.viz.films.film import check_film

            check_film(self.film, 640, 480)
        link = Link(
            self.lost, self.damaged, self.late, self.counts, self.current_bits, self.pwm_bits
        )
        with progress_bar("{task.completed}/{task.total} episodes") as bar:
            row = bar.add_task(f"on {self.target}", total=self.episodes)
            given = (
                self.folder,
                self.target,
                self.episodes,
                self.seed,
                link,
                self.loop,
                self.actuator,
            )
            done = board_test(*given, lambda ended: bar.update(row, completed=ended), self.trust)
        board, python = done.returns.mean(axis=0)
        taken = (
            "not counted here"
            if done.instructions is None
            else "{} and {}".format(*done.instructions)
        )
        rows = [
            ("return on the board, mean", f"{board:.6g}"),
            ("return in Python, mean", f"{python:.6g}"),
            ("episodes within 1 %", f"{done.alike} of {self.episodes}"),
            (
                "frames: sent, refused, without an answer",
                f"{done.frames}, {done.refused}, {done.unanswered}",
            ),
            ("observations beyond the limits", f"{done.stopped}"),
            ("samples of the current loop", f"{done.samples or 'none'}"),
            ("frames and samples a second", f"{done.rate:.0f}"),
            ("instructions of a policy step, a sample", taken),
        ]
        print_table(f"{self.folder} as C on {self.target}", ("", ""), rows)
        if self.log is not None:
            write_log(self.log, Contract.read(self.folder), done.on_board[0])
            print(f"wrote {self.log}; try: {command('board', 'check', self.folder, self.log)}")
        if self.film is not None:
            from codrl_mj.viz.films.film import film, record

            with Board(
                self.folder, self.target, link, self.seed, self.loop, self.actuator, self.trust
            ) as driving:
                env = driving.rig
                panel = record(driving, env, self.seed, 640, 480)
            title = f"{env.task} by its C on {self.target}: return {panel.episode.total:.0f}"
            film([dataclasses.replace(panel, title=title)], self.film, 640, 480)
            print(f"wrote {self.film}")
        return int(done.alike < 0.95 * self.episodes and link == Link() and self.actuator is None)


@dataclasses.dataclass(frozen=True)
class CheckLog:
    """Hold a log of a controller against the contract: names, order, units, rate, ranges, and every command.

    The log has comma-separated columns `name:unit`: time:s, the observations in their order, the
    commands. The status is 1 where commands are not the policy's, or came late.

    Example: codrl-mj board check furuta swing.csv
    """

    folder: Exported
    log: Annotated[
        tyro.conf.Positional[Path],
        tyro.conf.arg(metavar="LOG.csv", help="What the controller recorded."),
    ]

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
            (
                "commands that are not the policy's",
                f"{found.differing}, by {found.worst:.2g} at most",
            ),
        ]
        print_table(f"{self.log} by the contract of {self.folder}", ("", ""), rows)
        return int(found.differing > 0 or found.late > 0)


@dataclasses.dataclass(frozen=True)
class RunBoard:
    """Watch a real board at a serial port, or tell it to drive, and log what it says, until any key.

    It watches unless told to --drive: the board says its observations and which commands it would
    give. A motor moves only with --drive, which ends by itself when something is wrong, and always
    ends with the command for safety.

    Example: codrl-mj board run furuta --port /dev/ttyACM0 --out swing.csv
    """

    folder: Exported
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
        print(f"wrote {self.out}; try: {command('board', 'check', self.folder, self.out)}")
        return int(done.why != "told to")


@dataclasses.dataclass(frozen=True)
class CompareLog:
    """Simulate the commands of a rig's log, and hold what is observed then against what the rig did.

    The simulation begins anew at what was observed after each window. An error far below "if
    nothing changed" says that the simulation knows the rig; try --actuator with what identify wrote
    beside the motor of the training.

    Example: codrl-mj identify compare runs/furuta swing.csv --actuator motor/actuator.yaml --out
    compared.png
    """

    run_folder: Annotated[
        tyro.conf.Positional[Path],
        tyro.conf.arg(
            metavar="RUN",
            help="Run folder, or what export wrote of it: the environment of the training.",
        ),
    ]
    log: Annotated[
        tyro.conf.Positional[Path],
        tyro.conf.arg(
            metavar="LOG.csv", help="What the controller recorded, with columns name:unit."
        ),
    ]
    actuator: str | None = None
    """Actuator in the simulation, by name or file; that of the training unless told otherwise."""
    window: float | None = None
    """Time [s] after which the simulation begins anew; half a second, or ten rows, unless told otherwise."""
    out: Path | None = None
    """PNG file for curves of what was observed and simulated."""
    trust: Trust = False
    as_json: AsJson = False

    def run(self) -> tuple[int, Any]:
        """Compare, print a table, draw."""
        from codrl_mj.cli.terminal import print_table
        from codrl_mj.deploy import Contract, compare
        from codrl_mj.deploy.contract import FILE
        from codrl_mj.training.folder import load_config

        if self.out is not None and self.out.suffix != ".png":
            raise ValueError(f"--out {self.out}: the suffix must be .png")
        exported = (self.run_folder / FILE).is_file()
        env = (
            Contract.read(self.run_folder).environment(self.trust)
            if exported
            else load_config(self.run_folder, self.trust).env
        )
        found = compare(env, self.log, self.window, self.actuator)
        columns = list(
            zip(found.names, found.units, found.errors.tolist(), found.moved.tolist(), strict=True)
        )
        title = (
            f"{self.log.name} through {self.actuator or env.through}: {len(found.starts)} windows"
        )
        rows = [
            (name, unit or "?", f"{error:.3g}", f"{moved:.3g}")
            for name, unit, error, moved in columns
        ]
        heads = "", "unit", "error (RMS)", "if nothing changed"
        print_table(title, heads, rows, right=heads[2:])
        if self.out is not None:
            _draw(found, self.out)
        keys = ("name", "unit", "error", "if_nothing_changed")
        return 0, [dict(zip(keys, row, strict=True)) for row in columns]


def _draw(found: Any, out: Path) -> None:
    """Logged and simulated curves of every entry, cut where the simulation begins anew."""
    import numpy as np

    from codrl_mj.cli.motor import save_plot
    from codrl_mj.viz.pages.plots import Curve, Plot

    cut = found.simulated.copy()
    cut[found.starts[1:] - 1] = np.nan
    save_plot(
        [
            Plot(
                name,
                "time [s]",
                f"{name} [{unit or '?'}]",
                (
                    Curve("on the rig", found.time, found.logged[:, place], reference=True),
                    Curve("simulated", found.time, cut[:, place]),
                ),
            )
            for place, (name, unit) in enumerate(zip(found.names, found.units, strict=True))
        ],
        out,
    )
