"""`codrl-mj export`, `board` and `identify compare`: policies on boards, and logs of their rigs."""

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import tyro

from codrl_mj.actuators import family_name
from codrl_mj.boundary import Json
from codrl_mj.cli.environments import (
    AS_TRAINED,
    ActuatorName,
    EnvironmentVerb,
    build_env_config,
)
from codrl_mj.cli.parsing import AsJson, Output, Trust, parse_named_numbers
from codrl_mj.cli.subject import Source, Subject
from codrl_mj.envs.config import EnvConfig
from codrl_mj.fields import command, differences

# `codrl_mj.deploy` takes a while to import, so only the verbs that use it import it.
RigComparison = Any
"""Class of this name in `codrl_mj.deploy.compare`."""
Exported = Annotated[
    tyro.conf.Positional[Path], tyro.conf.arg(metavar="FOLDER", help="Folder that export wrote.")
]
"""Type of a field for a folder that `export` wrote."""


@dataclasses.dataclass(frozen=True)
class Export(EnvironmentVerb):
    """Export a trained policy as ONNX and C99, with all its assumptions in contract.json.

    The contract lists names, units, order and range of observations and actions, the rate, the
    actuator, the delays, and the reaction to missed deadlines. It also contains 200
    observations from episodes, with the policy's actions, as a reference for other programs
    (docs/deploy.md).

    Example: codrl-mj export runs/furuta-ppo-ideal-0 --out furuta
    """

    run_folder: Annotated[
        tyro.conf.Positional[Path],
        tyro.conf.arg(
            metavar="RUN",
            help=(
                "Run folder, a folder with only a policy, or a Stable-Baselines3 zip. The last two"
                " need --task and the settings of their training, such as --env.action voltage."
            ),
        ),
    ]
    source: tyro.conf.OmitArgPrefixes[Source] = Source()
    actuator_name: ActuatorName = AS_TRAINED
    out: Path = Path("exported")
    """Folder to write; it must be empty or not exist."""
    episodes: int = 5
    """Number of episodes from which the contract takes ranges and reference values."""
    seed: int = 0
    """Seed of the first episode; each further episode uses the next integer."""
    float64: bool = False
    """Compute with double instead of float in the C code."""
    limit: tuple[str, ...] = ()
    """Largest safe magnitudes of observations, such as arm_velocity=30 arm=1.8. Beyond them, the
    board applies the safe command. The name of an angle that is observed as cos_arm and sin_arm is
    arm.
    """
    board: str | None = None
    """Board whose memory and speed are checked: arduino-uno, arduino-due, nucleo-f446re,
    raspberry-pi-pico or teensy-4.1.
    """

    def run(self) -> int:
        """Write the folder and print its content."""
        from codrl_mj.cli.terminal import print_table
        from codrl_mj.deploy import export, extract_network

        subject = self.source.load(self.run_folder)
        env = self._environment(subject)
        limits = parse_named_numbers("--limit", self.limit, "arm_velocity=30")
        options = self.out, self.episodes, self.seed, self.float64, self.board, limits
        contract = export(subject.policy, env, subject.agent, *options)
        rows = [
            (side, entry["name"], entry.get("unit") or "?", _bounds(entry))
            for side, entries in (
                ("observation", contract.observations),
                ("action", contract.actions),
            )
            for entry in entries
        ]
        print_table(
            f"{contract.task}, {subject.agent}, {contract.rate:g} Hz",
            ("", "name", "unit", "range"),
            rows,
        )
        num_weights = extract_network(subject.policy).size
        if contract.controller["loop"] is None and contract.actuators:
            reason = (
                f"this policy commands a {env.action}"
                if env.action != "force"
                else "the motors have different loops, or none"
            )
            print(f"no current loop: {reason}")
        written = (
            f"wrote {self.out}: policy.onnx, contract.json, controller.c ({num_weights} numbers)"
        )
        names = env.task, *(family_name(type(entry)) for entry in env.actuators)
        print(
            f"{written}; try:"
            f" {command('board', 'test', self.out, trust=any(':' in name for name in names))}"
        )
        return 0

    def _environment(self, subject: Subject) -> EnvConfig:
        """Return the environment of the training, from the run folder or, for a zip, from flags."""
        from codrl_mj.training.folder import load_config

        trained_env = (
            subject.env
            if subject.run is None
            else load_config(subject.run, self.source.trust).evaluation_env
        )
        env = build_env_config(self, subject.env.task, self.actuator_name, trained_env)
        if subject.run is None:
            return env
        if differing_fields := differences(trained_env.as_mapping(), env.as_mapping()):
            raise ValueError(
                f"{', '.join(differing_fields)}: export uses the environment in which"
                f" {subject.run} was trained: omit these flags; evaluate and board test accept"
                " another --actuator"
            )
        return subject.env


def _bounds(entry: Mapping[str, Json]) -> str:
    if "levels" in entry:
        return f"one of {', '.join(f'{level:g}' for level in entry['levels'])}"
    low, high = entry.get("least"), entry.get("most")
    return "any" if low is None or high is None else f"{low:g} to {high:g}"


@dataclasses.dataclass(frozen=True)
class Test:
    """Run the exported C code as the controller of the simulation, compared with the ONNX model.

    The C code is compiled for this machine, or for a Cortex-M4F that QEMU emulates. The exit status
    is 1 if fewer than 95 % of the returns are within 1 % of those in Python. It is 0 in any case if
    you corrupt frames or change the motor.

    Example: codrl-mj board test furuta --target cortex-m4f
    """

    folder: Exported
    target: str = "host"
    """Machine that runs the C code: host, or cortex-m4f."""
    episodes: int = 20
    """Number of episodes, each with a different seed."""
    seed: int = 0
    """Seed of the first episode; each further episode uses the next integer."""
    loop: bool = True
    """Let the C code also close the motors' current loop, sample by sample, if it contains one."""
    actuator: str | None = None
    """Motor in the simulation, by name or file; default: the policy's."""
    lost: float = 0.0
    """Share of the frames that never reach the board."""
    damaged: float = 0.0
    """Share of the frames in which one bit is flipped."""
    late: float = 0.0
    """Share of the answers that arrive one period late. Until then the previous command is held."""
    counts: int = 0
    """Encoder counts per turn, such as 2048; 0: exact."""
    current_bits: int = 0
    """Resolution [bit] of the converter that measures the current, such as 12; 0: exact."""
    pwm_bits: int = 0
    """Resolution [bit] of the bridge's voltages; 0: exact."""
    film: Path | None = None
    """File for a film of the first episode with the board as the controller: .mp4 or .gif."""
    log: Path | None = None
    """CSV file for the observations and commands of the board in the first episode. `board check`
    reads this file.
    """
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
            options = (
                self.folder,
                self.target,
                self.episodes,
                self.seed,
                link,
                self.loop,
                self.actuator,
            )
            result = board_test(
                *options, lambda ended: bar.update(row, completed=ended), self.trust
            )
        board, python = result.returns.mean(axis=0)
        instructions = (
            "not counted on this target"
            if result.instructions is None
            else "{} and {}".format(*result.instructions)
        )
        rows = [
            ("return on the board, mean", f"{board:.6g}"),
            ("return in Python, mean", f"{python:.6g}"),
            ("episodes within 1 %", f"{result.num_equal_returns} of {self.episodes}"),
            (
                "frames: sent, refused, without an answer",
                f"{result.frames}, {result.refused}, {result.unanswered}",
            ),
            ("observations beyond the limits", f"{result.beyond_limits}"),
            ("samples of the current loop", f"{result.samples or 'none'}"),
            ("frames and samples per second", f"{result.rate:.0f}"),
            ("instructions per policy step, per sample", instructions),
        ]
        print_table(f"{self.folder} as C code on {self.target}", ("", ""), rows)
        if self.log is not None:
            write_log(self.log, Contract.read(self.folder), result.on_board[0])
            print(f"wrote {self.log}; try: {command('board', 'check', self.folder, self.log)}")
        if self.film is not None:
            from codrl_mj.viz.films.film import film, record

            with Board(
                self.folder, self.target, link, self.seed, self.loop, self.actuator, self.trust
            ) as board_policy:
                env = board_policy.rig
                panel = record(board_policy, env, self.seed, 640, 480)
            title = f"{env.task}, C code on {self.target}: return {panel.episode.total:.0f}"
            film([dataclasses.replace(panel, title=title)], self.film, 640, 480)
            print(f"wrote {self.film}")
        return int(
            result.num_equal_returns < 0.95 * self.episodes
            and link == Link()
            and self.actuator is None
        )


@dataclasses.dataclass(frozen=True)
class CheckLog:
    """Check a controller's log against the contract: names, order, units, rate, ranges, commands.

    The columns of the log are named `name:unit` and separated by commas: time:s, the observations
    in the order of the contract, and the commands. The exit status is 1 if commands differ from
    those of the policy or came late.

    Example: codrl-mj board check furuta swing.csv
    """

    folder: Exported
    log: Annotated[
        tyro.conf.Positional[Path],
        tyro.conf.arg(metavar="LOG.csv", help="Log of the controller."),
    ]

    def run(self) -> int:
        """Check the log and print a table."""
        from codrl_mj.cli.terminal import print_table
        from codrl_mj.deploy import check_log

        check = check_log(self.folder, self.log)
        outside = ", ".join(f"{name} in {count}" for name, count in check.outside.items() if count)
        rows = [
            ("rows; rate", f"{check.rows}; {check.rate:.4g} Hz"),
            ("came late", str(check.late)),
            ("observations outside the training's range", outside or "none"),
            (
                "commands that differ from the policy's",
                f"{check.differing}, by {check.worst:.2g} at most",
            ),
        ]
        print_table(f"{self.log} checked against the contract of {self.folder}", ("", ""), rows)
        return int(check.differing > 0 or check.late > 0)


@dataclasses.dataclass(frozen=True)
class RunBoard:
    """Watch a real board at a serial port, or let it drive the motor, and log its messages.

    Without --drive, the board only reports its observations and the commands that it would give.
    With --drive, the board moves the motor; the run then ends by itself on an error. Every run ends
    with the safe command. Any key ends a run.

    Example: codrl-mj board run furuta --port /dev/ttyACM0 --out swing.csv
    """

    folder: Exported
    port: str
    """Serial port, such as /dev/ttyACM0."""
    out: Path
    """CSV file for the log; `board check` and `identify` read it."""
    drive: bool = False
    """Let the board apply its commands to the motor."""
    seconds: float = math.inf
    """Maximum duration [s]."""
    baud: int = 115_200
    """Baud rate of the serial port [bit/s]."""

    def run(self) -> int:
        """Run until a key is pressed, and print a summary."""
        from codrl_mj.cli.terminal import any_key, print_table, print_text
        from codrl_mj.deploy import run_board

        print_text(f"{'DRIVES' if self.drive else 'watches'} {self.port}; any key ends it")
        with any_key() as pressed:
            options = self.folder, self.port, self.out, self.drive, self.seconds, self.baud
            result = run_board(*options, ended=pressed)
        rows = [
            ("ended", result.reason),
            (
                "rows; frames without an answer; late",
                f"{result.rows}; {result.missed}; {result.late}",
            ),
        ]
        print_table(f"{self.folder} on {self.port}", ("", ""), rows)
        print(f"wrote {self.out}; try: {command('board', 'check', self.folder, self.out)}")
        return int(result.reason != "requested")


@dataclasses.dataclass(frozen=True)
class CompareLog:
    """Simulate a rig with the commands in its log, and compare the observations.

    The simulation restarts from the rig's observation after each window. The column "if nothing
    changed" is the error of a prediction that holds the observation constant; an error far below it
    means that the simulation describes the rig. Compare the motor of the training with the file
    that identify wrote: name it with --actuator.

    Example: codrl-mj identify compare runs/furuta swing.csv --actuator motor/actuator.yaml --out
    compared.png
    """

    run_folder: Annotated[
        tyro.conf.Positional[Path],
        tyro.conf.arg(
            metavar="RUN",
            help="Run folder or its export, for the environment of the training.",
        ),
    ]
    log: Annotated[
        tyro.conf.Positional[Path],
        tyro.conf.arg(metavar="LOG.csv", help="Log of the controller, with columns name:unit."),
    ]
    actuator: str | None = None
    """Actuator in the simulation, by name or file; default: that of the training."""
    window: float | None = None
    """Time [s] after which the simulation restarts; default: half a second, but at least ten rows.
    """
    out: Path | None = None
    """PNG file for curves of the observed and simulated values."""
    trust: Trust = False
    as_json: AsJson = False

    def run(self) -> Output:
        """Compare, print a table, and draw the curves."""
        from codrl_mj.cli.terminal import print_table
        from codrl_mj.deploy import Contract, compare
        from codrl_mj.deploy.contract import FILE
        from codrl_mj.training.folder import load_config

        if self.out is not None and self.out.suffix != ".png":
            raise ValueError(f"--out {self.out}: the suffix must be .png")
        is_export = (self.run_folder / FILE).is_file()
        env = (
            Contract.read(self.run_folder).environment(self.trust)
            if is_export
            else load_config(self.run_folder, self.trust).env
        )
        comparison = compare(env, self.log, self.window, self.actuator)
        columns = list(
            zip(
                comparison.names,
                comparison.units,
                comparison.errors.tolist(),
                comparison.baseline_errors.tolist(),
                strict=True,
            )
        )
        title = (
            f"{self.log.name} through {self.actuator or env.actuator_label}:"
            f" {len(comparison.starts)} windows"
        )
        rows = [
            (name, unit or "?", f"{error:.3g}", f"{baseline:.3g}")
            for name, unit, error, baseline in columns
        ]
        heads = "", "unit", "error (RMS)", "if nothing changed"
        print_table(title, heads, rows, right=heads[2:])
        if self.out is not None:
            _draw(comparison, self.out)
        keys = ("name", "unit", "error", "if_nothing_changed")
        return 0, [dict(zip(keys, row, strict=True)) for row in columns]


def _draw(comparison: RigComparison, out: Path) -> None:
    """Draw logged and simulated curves of every entry, with gaps where the simulation restarts."""
    import numpy as np

    from codrl_mj.cli.motor import save_plot
    from codrl_mj.plots import Curve, Plot

    simulated = comparison.simulated.copy()
    # A NaN interrupts the line, so that no vertical stroke joins the end of one window to the start
    # of the next.
    simulated[comparison.starts[1:] - 1] = np.nan
    save_plot(
        [
            Plot(
                name,
                "time [s]",
                f"{name} [{unit or '?'}]",
                (
                    Curve(
                        "on the rig", comparison.time, comparison.logged[:, column], reference=True
                    ),
                    Curve("simulated", comparison.time, simulated[:, column]),
                ),
            )
            for column, (name, unit) in enumerate(
                zip(comparison.names, comparison.units, strict=True)
            )
        ],
        out,
    )
