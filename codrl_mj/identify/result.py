"""What identification found: every parameter with its interval and status, and the actuator that follows."""

import dataclasses
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, Literal

from codrl_mj.identify.parameters import OF_MOTOR, PARAMETERS
from codrl_mj.identify.prediction import Prediction, Trace
from codrl_mj.runs.files import write_json, writing

Status = Literal["identified", "rough", "given", "ratio", "unidentifiable", "refused"]
ACTUATOR = "actuator.yaml"  # name of the file in a folder of results
MISUNDERSTOOD = 0.2  # share of the motion beyond which it is not single numbers that are amiss
USABLE = ("identified", "rough", "given")


def missing(names: Collection[str], base: object) -> str | None:
    """Which numbers of a motor are neither among these nor in a base, and what to do; None: none."""
    needed = ("resistance", "inductance", "torque_constant", "back_emf_constant", "rotor_inertia")
    lacking = [name for name in needed if name not in names]
    if not lacking or base is not None:
        return None
    flags = " ".join(f"{name}=VALUE" for name in lacking)
    remedy = f"--known {flags}, or the motor that has the rest of its numbers with --motor NAME"
    if lacking[-1] == "rotor_inertia":
        remedy += (
            "; of the inertia that is found give the load's share: --known load_inertia=VALUE, 0 for a motor alone"
        )
    return f"{', '.join(lacking)}: these logs say nothing of {'it' if len(lacking) == 1 else 'them'}. Give {remedy}"


@dataclasses.dataclass(frozen=True)
class Estimate:
    """A parameter."""

    name: str
    value: float
    """In `unit`."""
    low: float
    """Lower end of the 95 % interval."""
    high: float
    status: Status
    why: str = ""
    """What the status comes from."""
    causes: Mapping[str, float] = dataclasses.field(default_factory=dict)
    """Half-widths of the interval by cause."""

    @property
    def unit(self) -> str:
        """Of its value."""
        return PARAMETERS[self.name].unit


@dataclasses.dataclass(frozen=True)
class Identified:
    """A motor as its logs show it.

    Raises:
        ValueError: by `actuator`, of a parameter that was not identified.
    """

    logs: tuple[str, ...]
    """Names of the logs."""
    rig: str
    friction: str
    driven_by: str | None
    """What drives the shaft in the fit; None where only the winding was fitted."""
    delays: Mapping[str, float]
    """Rows by which the input of `winding` and `shaft` was found late; a voltage of the rows' times by half of one."""
    estimates: tuple[Estimate, ...]
    fitted: tuple[Prediction, ...]
    """Errors on the logs that were fitted."""
    held_out: tuple[Prediction, ...]
    """And on those that were not."""
    warnings: tuple[str, ...]
    base: Mapping[str, Any] | None = None
    """The drive that gives what the logs do not tell, as a mapping; None: none."""
    traces: tuple[Trace, ...] = ()
    """Winding and shaft beside the logs that were fitted; in no file."""
    correlations: Mapping[str, Mapping[str, Mapping[str, float]]] = dataclasses.field(default_factory=dict)
    """Of the parameters of `winding` and `shaft`, each with each."""
    supply: float | None = None
    """Largest voltage [V] of the supply, or at the terminals, that the logs have; None: they have none."""
    unexplained: float = 0.0
    """Largest share of what moves in a log that the fit leaves unexplained, if that is more than sensors do."""

    def __getitem__(self, name: str) -> Estimate:
        """A parameter by its name."""
        for one in self.estimates:
            if one.name == name:
                return one
        raise KeyError(name)

    def problem(self) -> str | None:
        """What stands against an actuator of these numbers, with a remedy; None: nothing."""
        bad = [one for one in self.estimates if one.name in OF_MOTOR and one.status not in USABLE]
        alike: dict[str, list[str]] = {}
        for one in bad:
            alike.setdefault(f"{one.status}: {one.why}", []).append(one.name)
        told = "; ".join(f"{', '.join(s)} {'is' if len(s) == 1 else 'are'} {why}" for why, s in alike.items())
        if bad and self.unexplained > MISUNDERSTOOD:
            return (
                f"the fit leaves {self.unexplained:.0%} of what moves in a log unexplained, so that numbers mean "
                f"little ({told}). Correct the columns, their units and signs, or the rig: codrl-mj identify check"
            )
        if bad:
            them = "it" if len(bad) == 1 else "them"
            return f"{told}. Give {them} with --known {' '.join(f'{one.name}=VALUE' for one in bad)}"
        return missing([one.name for one in self.estimates], self.base)

    @property
    def supply_text(self) -> str | None:
        """What feeds the actuator that is written, and where that is from; None where there is none."""
        if self.problem() is not None:
            return None
        volts, of = self.actuator().voltage_limit, "assumed: set supply.voltage in actuator.yaml"
        if self.base is not None:
            of = "the motor's, by --motor"
        elif self.supply is not None:
            of = f"the largest of the logs; no current limit: set controller.max_current in {ACTUATOR}"
        return f"supply {volts:.4g} V: {of}"

    def intervals(self) -> dict[str, tuple[float, float]]:
        """Field of a drive -> interval, of what is used and is not a point."""
        return {
            f"motor.{one.name}": (one.low, one.high)
            for one in self.estimates
            if one.name in OF_MOTOR and one.status in USABLE and one.low < one.high
        }

    def actuator(self) -> Any:
        """The drive with the numbers that were identified or given.

        Raises:
            ValueError: one of them is neither; the message names it and what to do.
        """
        from codrl_mj.actuators import Drive, Supply, actuator_from_mapping

        problem = self.problem()
        if problem is not None:
            raise ValueError(problem)
        own = None if self.supply is None else Supply(self.supply)
        base = Drive(supply=own) if self.base is None else actuator_from_mapping(self.base)
        return base.replaced({f"motor.{one.name}": one.value for one in self.estimates if one.name in OF_MOTOR})

    def as_mapping(self) -> dict[str, Any]:
        """As JSON-serialisable values."""
        found = dataclasses.asdict(self) | {"problem": self.problem(), "supply_text": self.supply_text}
        del found["traces"]
        for one in (*found["fitted"], *found["held_out"]):
            del one["trace"]
        return found

    def as_file(self) -> dict[str, Any]:
        """What an actuator's file holds: a drive's fields, and `identified`, which has its intervals or its problem."""
        problem = self.problem()
        section: dict[str, Any] = {"logs": list(self.logs)}
        if problem is not None:
            return {"identified": section | {"problem": problem}}
        intervals = {name: list(ends) for name, ends in self.intervals().items()}
        return {**self.actuator().as_mapping(), "identified": section | {"intervals": intervals}}

    def write(self, folder: Path) -> list[Path]:
        """Write actuator.yaml and result.json into a folder, whole or not at all.

        Returns:
            Their paths.
        """
        import yaml

        actuator, result = folder / ACTUATOR, folder / "result.json"
        with writing(actuator) as temporary:
            temporary.write_text(yaml.safe_dump(self.as_file(), sort_keys=False))
        write_json(result, self.as_mapping())
        return [actuator, result]
