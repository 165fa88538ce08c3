"""Logs of a controller's observations and commands, and their check against the contract."""

import csv
import dataclasses
from pathlib import Path

import numpy as np

from codrl_mj.deploy.board import OnnxPolicy
from codrl_mj.deploy.contract import Contract, Interface
from codrl_mj.evaluation import Episode
from codrl_mj.runs.files import atomic_write


@dataclasses.dataclass(frozen=True)
class LogCheck:
    """Result of the check of a log against its contract."""

    rows: int
    """Number of rows."""
    rate: float
    """Median rate of the rows [Hz]."""
    late: int
    """Number of rows that came too long after the previous row, according to the contract."""
    outside: dict[str, int]
    """Observation -> number of rows beyond the golden range by more than a tenth of its width."""
    differing: int
    """Number of rows whose command differs from the policy's by more than the tolerance."""
    worst: float
    """Largest difference of a command, in its unit."""


def column_names(interface: Interface) -> list[str]:
    """Return the column names of a log: `time:s`, then observations and commands, `name:unit`."""
    names_and_units = [
        ("time", "s"),
        *(
            (entry["name"], entry["unit"])
            for entry in (*interface.observations, *interface.actions)
        ),
    ]
    return [f"{name}:{unit}" if unit else name for name, unit in names_and_units]


def motor_column_names(interface: Interface) -> list[str]:
    """Return the names of the optional columns with voltage, current and position of each motor."""
    units = {"voltage": "V", "current": "A", "position": "rad"}
    return [
        f"{action['name']}_{name}:{unit}"
        for action in interface.actions
        for name, unit in units.items()
    ]


def write_log(path: Path, contract: Contract, episode: Episode) -> None:
    """Write an episode as a log of observations, commands and motor measurements, as a board does.

    Args:
        path: CSV file for `column_names` and, if the motors have voltages and currents,
            `motor_column_names`.
        contract: contract of the policy.
        episode: episode with the policy.
    """
    motors = _measured(contract, episode)
    with atomic_write(path) as part, part.open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(
            column_names(contract) + (motor_column_names(contract) if motors.size else [])
        )
        commands = contract.to_commands(episode.action)
        for step, row in enumerate(
            np.hstack([episode.observation[:-1], commands, motors]).tolist()
        ):
            table.writerow([step / contract.rate, *row])


def _measured(contract: Contract, episode: Episode) -> np.ndarray:
    """Return voltage [V], current [A] and rotor angle [rad] of each motor, shape (T, 3 m).

    The values are those at the beginning of each step; the shape is (T, 0) if they are unknown.
    """
    steps, count = len(episode.time), len(contract.actions)
    if not {"voltage", "current"} <= episode.signals.keys():
        return np.zeros((steps, 0))
    speeds = np.vstack([episode.first_speeds, np.reshape(episode.trace["speed"], (-1, count))])
    # The angle is the integral of the joint's speed by the trapezoidal rule, as an encoder that
    # starts at zero would count it.
    angles = np.cumsum(episode.timestep * (speeds[1:] + speeds[:-1]) / 2.0, axis=0)
    angles = angles[episode.inner_steps - 1 :: episode.inner_steps] / [
        actuator.arm_radius for actuator in episode.actuators
    ]
    # An episode has the values at the end of each step, a log those at its beginning.
    at_end = [
        np.reshape(values, (steps, count))
        for values in (episode.signals["voltage"], episode.signals["current"], angles)
    ]
    at_start = np.stack(
        [np.vstack([np.zeros((1, count)), values[:-1]]) for values in at_end], axis=2
    )
    return at_start.reshape(steps, -1)


def read_rows(interface: Interface, path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Read a log that a controller recorded.

    Args:
        interface: interface of the policy, such as its contract.
        path: comma-separated columns `name:unit`: `time:s`, the observations in the order in which
            they were recorded, and the commands that were sent. Columns are found by their names; a
            unit that is left out is not compared. Columns of `motor_column_names` are ignored.

    Returns:
        Increasing times [s], shape (n,); observations, shape (n, k); and commands, shape (n, m), in
        the units of the interface's actions.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the table cannot be read, or its observations are not those of the policy:
            they are permuted, missing, unknown, in another unit, or at another rate.
    """
    # "utf-8-sig" skips the byte order mark that spreadsheet programs write.
    with path.open(newline="", encoding="utf-8-sig", errors="replace") as file:
        header, *rows = list(csv.reader(file)) or [[]]
    while rows and not rows[-1]:
        rows.pop()
    columns_and_units = [
        (name.strip(), unit.strip() or None)
        for name, _, unit in (cell.partition(":") for cell in header)
    ]
    names = [name for name, _ in columns_and_units]
    # Of several columns with the same name the last one is used.
    column_of = {name: column for column, name in enumerate(names)}
    if missing := [
        name
        for name in ("time", *(action["name"] for action in interface.actions))
        if name not in names
    ]:
        raise ValueError(
            f"{path}: has no column {missing[0]!r}, only {', '.join(names)}: call the columns"
            " name:unit"
        )
    if columns_and_units[column_of["time"]][1] not in (None, "s"):
        raise ValueError(
            f"{path}: column 'time': its unit is {columns_and_units[names.index('time')][1]},"
            " must be s: convert it"
        )
    for line, row in enumerate(rows, 2):
        if len(row) != len(header):
            raise ValueError(f"{path}: line {line} has {len(row)} cells, must have {len(header)}")
    try:
        table = np.array(rows, dtype=np.float64)
    except ValueError as error:
        raise ValueError(f"{path}: every cell must be a number: {error}") from None
    wrong = [
        f"line {row + 2}, {header[column]}: {table[row, column]}: must be a finite number"
        for row, column in np.argwhere(~np.isfinite(table))[:1]
    ]
    if wrong or len(table) < 2:
        raise ValueError(
            f"{path}: {wrong[0] if wrong else f'must have at least two rows, has {len(table)}'}"
        )
    if (steps := np.diff(table[:, column_of["time"]])).min() <= 0.0:
        raise ValueError(
            f"{path}: line {int(steps.argmin()) + 3}: time must increase from row to row"
        )
    command_columns = [column_of[action["name"]] for action in interface.actions]
    ignored = {column.partition(":")[0] for column in motor_column_names(interface)}
    observation_columns = [
        column
        for column, name in enumerate(names)
        if column not in (*command_columns, column_of["time"]) and name not in ignored
    ]
    interface.check_observations(
        [columns_and_units[column] for column in observation_columns],
        1.0 / float(np.median(steps)),
    )
    for action, column in zip(interface.actions, command_columns, strict=True):
        if (
            None not in (columns_and_units[column][1], action["unit"])
            and columns_and_units[column][1] != action["unit"]
        ):
            raise ValueError(
                f"{path}: action {action['name']!r}: its unit is {columns_and_units[column][1]},"
                f" must be {action['unit']}: convert it"
            )
    return (
        table[:, column_of["time"]],
        table[:, observation_columns],
        table[:, command_columns],
    )


def check_log(folder: Path, path: Path) -> LogCheck:
    """Check a log that a controller recorded against its contract.

    Args:
        folder: a folder that `codrl_mj.deploy.export` wrote.
        path: the log, as `read_rows` reads it.

    Raises:
        FileNotFoundError: a file is missing.
        ValueError: as `read_rows` says.
    """
    contract = Contract.read(folder)
    time, observed, commands = read_rows(contract, path)
    steps = np.diff(time)
    expected = contract.to_commands(OnnxPolicy(folder).predict(observed)[0])
    # Beyond a limit the C code gives the safe command.
    expected[~contract.is_within_limits(observed)] = contract.late["command"]
    errors = np.abs(commands - expected).max(axis=1)
    low, high = np.array([entry["seen"] for entry in contract.observations]).T
    is_outside = (observed < low - 0.1 * (high - low)) | (observed > high + 0.1 * (high - low))
    return LogCheck(
        rows=len(time),
        rate=1.0 / float(np.median(steps)),
        late=int((steps > contract.late["after"]).sum()),
        outside={
            entry["name"]: int(is_outside[:, index].sum())
            for index, entry in enumerate(contract.observations)
        },
        differing=int((errors > contract.golden["tolerance"]).sum()),
        worst=float(errors.max()),
    )
