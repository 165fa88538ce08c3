"""What a controller saw and did, as a table of columns, and whether its contract was kept."""

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
    """How a recorded log keeps its contract."""

    rows: int
    """Observations in it."""
    rate: float
    """Median of how many came in a second [Hz]."""
    late: int
    """How many came later after the one before than the contract allows."""
    outside: dict[str, int]
    """Observation -> in how many rows it is outside of what the golden episodes had, by more than a tenth."""
    differing: int
    """Rows whose command is not the policy's, by more than the contract's tolerance."""
    worst: float
    """Largest difference of a command, in its unit."""


def columns(interface: Interface) -> list[str]:
    """What a log's columns are called: `time:s`, observations and commands, `name:unit`."""
    named = [
        ("time", "s"),
        *((one["name"], one["unit"]) for one in (*interface.observations, *interface.actions)),
    ]
    return [f"{name}:{unit}" if unit else name for name, unit in named]


def motor_columns(interface: Interface) -> list[str]:
    """What a board may tell besides, of each motor."""
    units = {"voltage": "V", "current": "A", "position": "rad"}
    return [
        f"{one['name']}_{name}:{unit}" for one in interface.actions for name, unit in units.items()
    ]


def write_log(path: Path, contract: Contract, episode: Episode) -> None:
    """Write an episode as a log, as a board writes it: what it saw, did and measured at the motors.

    Args:
        path: CSV file for `columns` and, of motors that have voltages and currents,
            `motor_columns`.
        contract: of what acted.
        episode: what it did.
    """
    motors = _measured(contract, episode)
    with atomic_write(path) as part, part.open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(columns(contract) + (motor_columns(contract) if motors.size else []))
        commands = contract.commands(episode.action)
        for step, row in enumerate(
            np.hstack([episode.observation[:-1], commands, motors]).tolist()
        ):
            table.writerow([step / contract.rate, *row])


def _measured(contract: Contract, episode: Episode) -> np.ndarray:
    """Voltage [V], current [A], turn [rad] of each rotor as each step begins, (T, 3 m); (T, 0) where none is known."""
    steps, count = len(episode.time), len(contract.actions)
    if not {"voltage", "current"} <= episode.signals.keys():
        return np.zeros((steps, 0))
    speeds = np.vstack([episode.first_speeds, np.reshape(episode.trace["speed"], (-1, count))])
    turned = np.cumsum(episode.timestep * (speeds[1:] + speeds[:-1]) / 2.0, axis=0)
    turned = turned[episode.inner_steps - 1 :: episode.inner_steps] / [
        one.arm_radius for one in episode.actuators
    ]
    ends = [
        np.reshape(one, (steps, count))
        for one in (episode.signals["voltage"], episode.signals["current"], turned)
    ]
    before = np.stack([np.vstack([np.zeros((1, count)), one[:-1]]) for one in ends], axis=2)
    return before.reshape(steps, -1)


def read_rows(interface: Interface, path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Read a log that a controller recorded.

    Args:
        interface: what passes between the policy and what it controls, as its contract has it.
        path: comma-separated columns `name:unit`: `time:s`, the observations in the order in which
            they came, and the commands that were sent. Columns are known by their names; a unit
            that is left out is not compared. Those of `motor_columns` are passed over.

    Returns:
        Time [s], shape (n,), increasing; what was observed, shape (n, k); and the commands, shape
        (n, m), in the units
            of the interface's actions.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the table cannot be read, or its observations are not those of the policy:
            permuted, missing, unknown, of another unit, at another rate.
    """
    with path.open(newline="", encoding="utf-8-sig", errors="replace") as file:
        header, *rows = list(csv.reader(file)) or [[]]
    while rows and not rows[-1]:
        rows.pop()
    told = [
        (name.strip(), unit.strip() or None)
        for name, _, unit in (one.partition(":") for one in header)
    ]
    names = [name for name, _ in told]
    where = {name: place for place, name in enumerate(names)}  # of equal names the last
    if missing := [
        one for one in ("time", *(one["name"] for one in interface.actions)) if one not in names
    ]:
        raise ValueError(
            f"{path}: has no column {missing[0]!r}, only {', '.join(names)}: call the columns"
            " name:unit"
        )
    if told[where["time"]][1] not in (None, "s"):
        raise ValueError(
            f"{path}: column 'time': its unit is {told[names.index('time')][1]}, must be s:"
            " convert it"
        )
    for place, row in enumerate(rows, 2):
        if len(row) != len(header):
            raise ValueError(f"{path}: line {place} has {len(row)} cells, must have {len(header)}")
    try:
        table = np.array(rows, dtype=np.float64)
    except ValueError as error:
        raise ValueError(f"{path}: every cell must be a number: {error}") from None
    wrong = [
        f"line {row + 2}, {header[place]}: {table[row, place]}: must be a finite number"
        for row, place in np.argwhere(~np.isfinite(table))[:1]
    ]
    if wrong or len(table) < 2:
        raise ValueError(
            f"{path}: {wrong[0] if wrong else f'must have at least two rows, has {len(table)}'}"
        )
    if (steps := np.diff(table[:, where["time"]])).min() <= 0.0:
        raise ValueError(
            f"{path}: line {int(steps.argmin()) + 3}: time must increase from row to row"
        )
    sent = [where[one["name"]] for one in interface.actions]
    beside = {one.partition(":")[0] for one in motor_columns(interface)}
    seen = [
        place
        for place, name in enumerate(names)
        if place not in (*sent, where["time"]) and name not in beside
    ]
    interface.admit([told[place] for place in seen], 1.0 / float(np.median(steps)))
    for one, place in zip(interface.actions, sent, strict=True):
        if None not in (told[place][1], one["unit"]) and told[place][1] != one["unit"]:
            raise ValueError(
                f"{path}: action {one['name']!r}: its unit is {told[place][1]}, must be"
                f" {one['unit']}: convert it"
            )
    return table[:, where["time"]], table[:, seen], table[:, sent]


def check_log(folder: Path, path: Path) -> LogCheck:
    """Hold a log that a controller recorded against its contract.

    Args:
        folder: what `codrl_mj.deploy.export` wrote.
        path: the log, as `read_rows` reads it.

    Raises:
        FileNotFoundError: a file is missing.
        ValueError: as `read_rows` says.
    """
    contract = Contract.read(folder)
    time, observed, commands = read_rows(contract, path)
    steps = np.diff(time)
    expected = contract.commands(OnnxPolicy(folder).predict(observed)[0])
    expected[~contract.within(observed)] = contract.late[
        "command"
    ]  # what the C gives beyond a limit
    off = np.abs(commands - expected).max(axis=1)
    low, high = np.array([one["seen"] for one in contract.observations]).T
    beyond = (observed < low - 0.1 * (high - low)) | (observed > high + 0.1 * (high - low))
    return LogCheck(
        rows=len(time),
        rate=1.0 / float(np.median(steps)),
        late=int((steps > contract.late["after"]).sum()),
        outside={
            one["name"]: int(beyond[:, place].sum())
            for place, one in enumerate(contract.observations)
        },
        differing=int((off > contract.golden["tolerance"]).sum()),
        worst=float(off.max()),
    )
