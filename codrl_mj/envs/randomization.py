"""Actuators and models drawn at every reset, from the environment's own generator."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from codrl_mj.actuators import (
    Actuator,
    ActuatorModel,
    Family,
    Ideal,
    field_paths,
    field_values,
    options_of,
    parameter_paths,
    unchecked,
)
from codrl_mj.disturbances import Joint
from codrl_mj.envs.commands import Commands
from codrl_mj.envs.distributions import Choice, Distribution
from codrl_mj.fields import did_you_mean
from codrl_mj.physics.variation import Variation, additions_of, variable

LIMIT = 1000
"""Draws of an unstable loop in a row after which a reset gives up."""


@dataclasses.dataclass(frozen=True)
class Randomization:
    """What is drawn at a reset, and what it does to actuators and model; made by `build`."""

    distributions: dict[str, Distribution]
    """Name of a field -> what it is drawn from."""
    family: Family
    """Of what is simulated."""
    kinds: dict[str, type]
    """Name of a field -> float, int or bool."""
    timestep: float
    """Integration step [s], at which a drawn loop must be stable."""
    allow_unstable: bool
    """Whether unstable loops are kept."""
    variation: Variation | None
    """What drawn fields do to the model; None if they do nothing."""
    mounted: tuple[str, ...]
    """The fields that the actuator's arm and additions to its joint depend on."""
    in_model: tuple[str, ...]
    """The fields that the model, besides its actuators, depends on."""

    @classmethod
    def build(
        cls,
        randomize: Mapping[str, Distribution],
        task: str,
        actuator: ActuatorModel,
        commands: Commands,
        timestep: float,
        allow_unstable: bool,
        joint: Joint,
    ) -> "Randomization":
        """Check the distributions against the fields that they are for.

        Args:
            randomize: name of a field -> distribution; at least one. All actuators of a task get what is drawn.
            task: the task's name.
            actuator: the nominal one.
            commands: what an action stands for.
            timestep: integration step [s].
            allow_unstable: keep unstable loops.
            joint: what is added to the actuated joints.

        Raises:
            ValueError: an unknown field (the nearest is suggested), one that cannot be drawn here, or impossible
                bounds; the message names field, value and bound.
        """
        if not isinstance(randomize, Mapping) or not randomize:
            raise ValueError(f"randomize = {randomize!r}: must be a mapping of one or more fields to distributions")
        family: Any = Actuator if isinstance(actuator, Ideal) else type(actuator)
        known = (*field_paths(family), *variable(task))
        for name, distribution in randomize.items():
            if name not in known:
                hint = did_you_mean(name, known)
                raise ValueError(f"randomize: unknown field {name!r}: {hint}{task} has {', '.join(known)}")
            if not isinstance(distribution, Distribution):
                raise ValueError(f"randomize[{name!r}] = {distribution!r}: must be a Uniform, LogUniform or Choice")
            try:
                _check(name, distribution, actuator, commands)
            except ValueError as error:
                raise ValueError(f"randomize[{name!r}] = {distribution}: {error}") from None
        model = [name for name in randomize if name.startswith("model.")]
        simulated = commands.simulated[0]
        turned, added = (
            [name for name in randomize if name not in model and _follows(of, simulated, name)] for of in _MOUNTING
        )
        in_model = (*model, *added)
        variation = Variation(task, model, joint=joint, mounting=bool(added)) if in_model else None
        kinds = {name: _kind(family, name) for name in randomize}
        return cls(
            dict(randomize),
            type(simulated),
            kinds,
            timestep,
            allow_unstable,
            variation,
            tuple(turned + added),
            in_model,
        )

    @property
    def names(self) -> tuple[str, ...]:
        """The fields, in the order in which they are drawn."""
        return tuple(self.distributions)

    @property
    def draws_actuator(self) -> bool:
        """Whether a field of the actuator is drawn, and so its stability must be checked at every draw."""
        return any(not name.startswith("model.") for name in self.distributions)

    def draw(
        self, random: Callable[[np.ndarray, int], np.ndarray], nominal: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Draw the fields of m environments; whole sets are redrawn until their actuators are stable.

        `random` takes (positions in `nominal`, count), and returns the next `count` numbers in [0, 1) of each of their
        generators; `nominal` is of what is simulated, as `nominal_fields` has it. Returned are the values (m, k), and
        how many sets were rejected before, (m,).

        Raises:
            ValueError: `LIMIT` sets in a row were unstable.
        """
        values = np.empty((len(nominal), len(self.distributions)))
        rejected = np.zeros(len(nominal), dtype=np.int64)
        pending = np.arange(len(nominal))
        while True:
            draws = random(pending, len(self.distributions))
            for column, distribution in enumerate(self.distributions.values()):
                values[pending, column] = distribution.transform(draws[:, column].copy())
            if self.allow_unstable or not self.draws_actuator:
                return values, rejected
            drawn = self.numbers(self.drawn(nominal[pending], values[pending]))
            flat = drawn.reshape(-1, drawn.shape[-1])
            unstable = ~(self.family.instability(flat, self.timestep) < 1.0)
            unstable = unstable.reshape(drawn.shape[:2]).any(axis=1)
            if not unstable.any():
                return values, rejected
            pending = pending[unstable]
            rejected[pending] += 1
            if rejected[pending[0]] == LIMIT:
                last = {name: float(value) for name, value in zip(self.names, values[pending[0]], strict=True)}
                raise ValueError(
                    f"randomize: {LIMIT} draws in a row have an unstable current loop at a step of "
                    f"{self.timestep:g} s; the last was {last}{_reason(self.family, drawn[unstable][0], self.timestep)}"
                    ". Narrow the bounds, shorten the step, or pass allow_unstable=True"
                )

    def drawn(self, nominal: np.ndarray, values: np.ndarray) -> np.ndarray:
        """The fields of actuators, as `nominal_fields` has them, with the drawn values (m, k) in place of theirs."""
        fields, paths = nominal.copy(), field_paths(self.family)
        for name, column in zip(self.names, values.T, strict=True):
            if not name.startswith("model."):
                fields[:, :, paths.index(name)] = column[:, np.newaxis]
        return fields

    def numbers(self, fields: np.ndarray) -> np.ndarray:
        """The numbers, shape (m, n, p), of actuators with the given fields (m, n, f)."""
        paths = field_paths(self.family)
        return fields[:, :, [paths.index(path) for path in parameter_paths(self.family).values()]]

    def mounting(self, fields: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The arms [m], shape (m, n), of actuators with the given fields (m, n, f), and their additions, (m, n, 3)."""
        return mounting_of([[unchecked(self.family, one) for one in each] for each in fields.tolist()])

    def nominal_values(self, simulated: Sequence[ActuatorModel]) -> np.ndarray:
        """The values, shape (k,), with which actuator and model are as they are before the first draw."""
        fields = dict(zip(field_paths(self.family), field_values(simulated[0]), strict=True))
        model = {name: float(not name.startswith("model.damping.")) for name in self.names if name.startswith("model.")}
        return np.array([(fields | model)[name] for name in self.names])

    def model_fields(
        self, values: np.ndarray, additions: np.ndarray | None = None, drawn: bool = False
    ) -> dict[str, np.ndarray]:
        """The drawn fields of the model; see `Variation.fields`."""
        if self.variation is None:
            return {}
        columns = [self.names.index(name) for name in self.variation.names]
        return self.variation.fields(values[:, columns], additions, drawn)

    def actuator(self, nominal: ActuatorModel, values: np.ndarray) -> Any:
        """The nominal actuator with one environment's drawn values, shape (k,)."""
        drawn = self.report(values, 0)
        return nominal.replaced({name: drawn[name] for name in self.names if not name.startswith("model.")})

    def report(self, values: np.ndarray, rejected: int) -> dict[str, Any]:
        """What one environment's `info` says of its draw: the values (k,) by name, and the number of rejected sets."""
        drawn = {name: self.kinds[name](value) for name, value in zip(self.names, values, strict=True)}
        return drawn | {"rejected": int(rejected)}

    def reports(self, rows: np.ndarray, values: np.ndarray, rejected: np.ndarray) -> dict[str, Any]:
        """The same for rows of a vector environment, as Gymnasium's vector infos: nested, with masks.

        `values` (N, k) and `rejected` (N,) are of all environments.
        """
        mask = np.zeros(len(values), dtype=bool)
        mask[rows] = True
        columns = {name: values[:, column] for column, name in enumerate(self.names)} | {"rejected": rejected}
        report: dict[str, Any] = {}
        for name, column in columns.items():
            report[name] = np.zeros(len(values), dtype=int if name == "rejected" else self.kinds[name])
            report[name][rows] = column[rows]
            report[f"_{name}"] = mask.copy()
        return {"randomization": report, "_randomization": mask}


def nominal_fields(actuators: Sequence[Sequence[ActuatorModel]]) -> np.ndarray:
    """The fields of the actuators of m environments, shape (m, n, f), columns as in `field_paths`."""
    return np.array([[field_values(one) for one in each] for each in actuators])


def mounting_of(actuators: Sequence[Sequence[ActuatorModel]]) -> tuple[np.ndarray, np.ndarray]:
    """The arms [m] of the actuators of m environments, shape (m, n), and what they add to their joints, (m, n, 3)."""
    return np.array([[one.arm_radius for one in each] for each in actuators]), additions_of(actuators)


_MOUNTING: tuple[Callable[[ActuatorModel], Any], ...] = (lambda one: one.arm_radius, lambda one: one.additions)


def _follows(of: Callable[[ActuatorModel], Any], actuator: ActuatorModel, name: str) -> bool:
    """Whether something of an actuator depends on a field: at the actuator's values, or where no other field is 0."""
    family: Family = type(actuator)
    paths = field_paths(family)
    for values in (field_values(actuator), (2.0,) * len(paths)):
        other = [value + (path == name) for path, value in zip(paths, values, strict=True)]
        if of(unchecked(family, values)) != of(unchecked(family, other)):
            return True
    return False


def _kind(family: Family, name: str) -> type:
    """What a field holds: float, int or bool."""
    if name.startswith("model."):
        return float
    value: Any = family()
    for part in name.split("."):
        value = getattr(value, part, None)
    return type(value) if isinstance(value, int) else float


def _reason(family: Family, numbers: np.ndarray, timestep: float) -> str:
    """What an actuator that was drawn says of itself."""
    try:
        family.from_numbers(numbers[0]).check(timestep)
    except ValueError as error:
        return f": {error}"
    return ""


def _check(name: str, distribution: Distribution, actuator: ActuatorModel, commands: Commands) -> None:
    """Refuse what cannot be drawn.

    Raises:
        ValueError: the reason.
    """
    part, _, field = name.partition(".")
    if part == "model":
        low = min(distribution.extremes)
        allowed_zero = field == "gravity" or field.startswith("damping.")
        if not np.isfinite(distribution.extremes).all() or low < 0.0 or (low == 0.0 and not allowed_zero):
            raise ValueError(f"{name} = {low:g}: must be a finite number {'>=' if allowed_zero else '>'} 0")
        return
    if isinstance(actuator, Ideal):
        raise ValueError("the ideal actuator has no motor and no controller to draw; choose another actuator")
    if name in commands.fixed:
        raise ValueError(f"with action={commands.name!r} {commands.fixed[name]}; draw it with action='force'")
    kind = _kind(type(actuator), name)
    words = options_of(type(actuator), name)
    if words:
        if not isinstance(distribution, Choice) or any(value not in range(len(words)) for value in distribution.values):
            numbered = ", ".join(f"{place} for {word}" for place, word in enumerate(words))
            raise ValueError(f"{name} is a word: draw it from a Choice of {numbered}")
    elif kind is not float:
        if not isinstance(distribution, Choice) or any(type(value) is not kind for value in distribution.values):
            raise ValueError(f"{name} must be drawn from a Choice of {kind.__name__} values")
    elif any(isinstance(value, bool) for value in distribution.extremes):
        raise ValueError(f"{name} must be a number")
    for value in distribution.extremes:
        actuator.replaced({name: value})  # the field's own bounds
