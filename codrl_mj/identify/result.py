"""What identification found: every parameter with its interval and status, and the actuator that follows."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from codrl_mj.identify.parameters import PARAMETERS
from codrl_mj.identify.prediction import Prediction
from codrl_mj.identify.traces import Trace
from codrl_mj.runs.files import write_json, writing

Status = Literal["identified", "rough", "given", "ratio", "unidentifiable", "refused"]
USABLE = ("identified", "rough", "given")
OF_MOTOR = (
    *("resistance", "inductance", "torque_constant", "back_emf_constant", "rotor_inertia", "gear_ratio"),
    *("gear_efficiency", "coulomb_friction", "viscous_friction", "stribeck_friction", "stribeck_speed"),
)
"""Fields of `GearMotor` that are identified or known."""


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

    def __getitem__(self, name: str) -> Estimate:
        """A parameter by its name."""
        for one in self.estimates:
            if one.name == name:
                return one
        raise KeyError(name)

    def problem(self) -> str | None:
        """What stands against an actuator of these numbers, with a remedy; None: nothing."""
        known = {one.name: one for one in self.estimates}
        for one in self.estimates:
            if one.name in OF_MOTOR and one.status not in USABLE:
                return f"{one.name} is {one.status}: {one.why}. Give it with --known {one.name}=VALUE"
        for name in ("resistance", "inductance", "torque_constant", "back_emf_constant", "rotor_inertia"):
            if name not in known and self.base is None:
                remedy = f"--known {name}=VALUE, or the motor that has the rest of its numbers with --motor NAME"
                if name == "rotor_inertia":
                    remedy += "; of the inertia that was found give the load's share: --known load_inertia=VALUE"
                return f"{name}: these logs say nothing of it. Give {remedy}"
        return None

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
        from codrl_mj.actuators import Drive, actuator_from_mapping

        problem = self.problem()
        if problem is not None:
            raise ValueError(problem)
        base = Drive() if self.base is None else actuator_from_mapping(self.base)
        return base.replaced({f"motor.{one.name}": one.value for one in self.estimates if one.name in OF_MOTOR})

    def as_mapping(self) -> dict[str, Any]:
        """As JSON-serialisable values."""
        found = dataclasses.asdict(self) | {"problem": self.problem()}
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

        actuator, result = folder / "actuator.yaml", folder / "result.json"
        with writing(actuator) as temporary:
            temporary.write_text(yaml.safe_dump(self.as_file(), sort_keys=False))
        write_json(result, self.as_mapping())
        return [actuator, result]
