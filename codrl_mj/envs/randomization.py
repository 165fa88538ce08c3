"""Actuators and models drawn at every reset, from the environment's own generator."""

import dataclasses
import difflib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from codrl_mj.envs.distributions import Choice, Distribution
from codrl_mj.motor import Actuator, CurrentLoop, Motor, spectral_radii, to_vector
from codrl_mj.motor.parameters import INDUCTANCE, PARAMETER_NAMES, RESISTANCE, SUBSTEPS
from codrl_mj.physics.variation import Variation, variable

LIMIT = 1000
"""Draws of an unstable loop in a row after which a reset gives up."""

_ARM = "motor.arm_radius"
_PARTS: dict[str, type] = {"motor": Motor, "controller": CurrentLoop}
_WHOLE: dict[str, type] = {"controller.substeps": int, "controller.bemf_compensation": bool}
"""Fields that are not any number: only a `Choice` of these."""
_ACTUATOR_FIELDS = tuple(f"{part}.{field.name}" for part, cls in _PARTS.items() for field in dataclasses.fields(cls))


@dataclasses.dataclass(frozen=True)
class Randomization:
    """What is drawn at a reset, and what it does to actuator and model; made by `build`."""

    distributions: dict[str, Distribution]
    """Name of a field -> what it is drawn from."""
    timestep: float
    """Integration step [s], at which a drawn loop must be stable."""
    allow_unstable: bool
    """Whether unstable loops are kept."""
    variation: Variation | None
    """What the drawn model fields do; None if there are none."""
    supply_resistance: float = 0.0
    """Resistance [ohm] of the supply, for which a drawn winding must not be too fast either."""

    @classmethod
    def build(
        cls,
        randomize: Mapping[str, Distribution],
        task: str,
        actuator: Actuator | None,
        command: str,
        timestep: float,
        allow_unstable: bool,
        supply_resistance: float = 0.0,
    ) -> "Randomization":
        """Check the distributions against the fields that they are for.

        Args:
            randomize: name of a field -> distribution; at least one.
            task: the task's name.
            actuator: the nominal one; None is the ideal one.
            command: what an action stands for.
            timestep: integration step [s].
            allow_unstable: keep unstable loops.
            supply_resistance: of the supply [ohm].

        Raises:
            ValueError: an unknown field (the nearest is suggested), one that cannot be drawn here, or impossible
                bounds; the message names field, value and bound.
        """
        if not isinstance(randomize, Mapping) or not randomize:
            raise ValueError(f"randomize = {randomize!r}: must be a mapping of one or more fields to distributions")
        known = (*_ACTUATOR_FIELDS, *variable(task))
        for name, distribution in randomize.items():
            if name not in known:
                near = difflib.get_close_matches(str(name), known, n=1, cutoff=0.5)
                hint = f"did you mean {near[0]!r}? " if near else ""
                raise ValueError(f"randomize: unknown field {name!r}: {hint}{task} has {', '.join(known)}")
            if not isinstance(distribution, Distribution):
                raise ValueError(f"randomize[{name!r}] = {distribution!r}: must be a Uniform, LogUniform or Choice")
            try:
                _check(name, distribution, actuator, command)
            except ValueError as error:
                raise ValueError(f"randomize[{name!r}] = {distribution}: {error}") from None
        model = [name for name in randomize if name.startswith("model.")]
        variation = Variation(task, model) if model else None
        return cls(dict(randomize), timestep, allow_unstable, variation, supply_resistance)

    @property
    def names(self) -> tuple[str, ...]:
        """The fields, in the order in which they are drawn."""
        return tuple(self.distributions)

    @property
    def draws_actuator(self) -> bool:
        """Whether a field of the actuator is drawn, and so its stability must be checked at every draw."""
        return any(not name.startswith("model.") for name in self.distributions)

    def draw(
        self,
        random: Callable[[np.ndarray, int], np.ndarray],
        vectors: np.ndarray,
        arms: np.ndarray,
        radii_of: Callable[[np.ndarray, float], np.ndarray] = spectral_radii,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Draw the fields of some environments; whole sets are redrawn until the current loop is stable.

        Args:
            random: (positions in `vectors`, count) -> the next `count` numbers in [0, 1) of each of their generators.
            vectors: nominal parameter vectors, shape (m, p); p = 0 for ideal actuators.
            arms: nominal arms [m], shape (m,).
            radii_of: `spectral_radii`, or what is below 1 exactly where they are.

        Returns:
            Values (m, k), and how many sets were rejected before, (m,).

        Raises:
            ValueError: `LIMIT` sets in a row were unstable.
        """
        values = np.empty((len(vectors), len(self.distributions)))
        rejected = np.zeros(len(vectors), dtype=np.int64)
        pending = np.arange(len(vectors))
        while True:
            draws = random(pending, len(self.distributions))
            for column, distribution in enumerate(self.distributions.values()):
                values[pending, column] = distribution.transform(draws[:, column].copy())
            if self.allow_unstable or not self.draws_actuator:
                return values, rejected
            drawn, _ = self.parameters(vectors[pending], arms[pending], values[pending])
            radii = radii_of(drawn, self.timestep)
            if self.supply_resistance:  # under a saturated voltage the current is fed back through the supply
                pole = (drawn[:, RESISTANCE] + self.supply_resistance) * self.timestep
                radii = np.maximum(radii, np.abs(1.0 - pole / (drawn[:, INDUCTANCE] * drawn[:, SUBSTEPS])))
            unstable = ~(radii < 1.0)
            if not unstable.any():
                return values, rejected
            pending = pending[unstable]
            rejected[pending] += 1
            if rejected[pending[0]] == LIMIT:
                last = {name: float(value) for name, value in zip(self.names, values[pending[0]], strict=True)}
                last_radius = spectral_radii(drawn[unstable][:1], self.timestep)[0]
                raise ValueError(
                    f"randomize: {LIMIT} draws in a row have an unstable current loop at a step of "
                    f"{self.timestep:g} s; the last was {last} with spectral radius {last_radius:.4g}, must be "
                    "< 1. Narrow the bounds, shorten the step, or pass allow_unstable=True"
                )

    def parameters(self, vectors: np.ndarray, arms: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Parameter vectors (m, p) and arms (m,) with the drawn values in place of the nominal ones."""
        vectors, arms = vectors.copy(), arms.copy()
        for name, column in zip(self.names, values.T, strict=True):
            if name == _ARM:
                arms[:] = column
            elif not name.startswith("model."):
                vectors[:, PARAMETER_NAMES.index(name.partition(".")[2])] = column
        return vectors, arms

    def nominal_values(self, actuator: Actuator | None) -> np.ndarray:
        """The values, shape (k,), with which actuator and model are as they are before the first draw."""
        vectors, arms = nominal_parameters([] if actuator is None else [actuator])
        values = []
        for name in self.names:
            if name.startswith("model."):
                values.append(0.0 if name.startswith("model.damping.") else 1.0)
            else:
                values.append(arms[0] if name == _ARM else vectors[0, PARAMETER_NAMES.index(name.partition(".")[2])])
        return np.array(values)

    def model_fields(self, values: np.ndarray, drawn: bool = False) -> dict[str, np.ndarray]:
        """The drawn fields of the model; see `Variation.fields`."""
        if self.variation is None:
            return {}
        columns = [self.names.index(name) for name in self.variation.names]
        return self.variation.fields(values[:, columns], drawn)

    def actuator(self, nominal: Actuator, values: np.ndarray) -> Actuator:
        """The nominal actuator with one environment's drawn values, shape (k,)."""
        changes: dict[str, dict[str, Any]] = {part: {} for part in _PARTS}
        for name, value in self.report(values, 0).items():
            part, _, field = name.partition(".")
            if part in changes:
                changes[part][field] = value
        return Actuator(
            dataclasses.replace(nominal.motor, **changes["motor"]),
            dataclasses.replace(nominal.controller, **changes["controller"]),
        )

    def report(self, values: np.ndarray, rejected: int) -> dict[str, Any]:
        """What one environment's `info` says of its draw: the values (k,) by name, and the number of rejected sets."""
        drawn = {name: _kind(name)(value) for name, value in zip(self.names, values, strict=True)}
        return drawn | {"rejected": int(rejected)}

    def reports(self, rows: np.ndarray, values: np.ndarray, rejected: np.ndarray) -> dict[str, Any]:
        """The same for rows of a vector environment, as Gymnasium's vector infos: nested, with masks.

        Args:
            rows: the rows that were drawn.
            values: of all environments, shape (N, k).
            rejected: of all environments, shape (N,).
        """
        mask = np.zeros(len(values), dtype=bool)
        mask[rows] = True
        columns = {name: values[:, column] for column, name in enumerate(self.names)} | {"rejected": rejected}
        report: dict[str, Any] = {}
        for name, column in columns.items():
            report[name] = np.zeros(len(values), dtype=int if name == "rejected" else _kind(name))
            report[name][rows] = column[rows]
            report[f"_{name}"] = mask.copy()
        return {"randomization": report, "_randomization": mask}


def nominal_parameters(actuators: Sequence[Actuator], count: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Parameter vectors (m, p) and arms [m] (m,) of some actuators; of `count` ideal ones, p = 0, if there are none."""
    if not actuators:
        return np.empty((count, 0)), np.ones(count)
    vectors = np.array([to_vector(actuator) for actuator in actuators])
    return vectors, np.array([actuator.motor.arm_radius for actuator in actuators])


def _kind(name: str) -> type:
    return _WHOLE.get(name, float)


def _check(name: str, distribution: Distribution, actuator: Actuator | None, command: str) -> None:
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
    if actuator is None:
        raise ValueError("the ideal actuator has no motor and no controller to draw; choose another actuator")
    if command != "force" and name in ("motor.torque_constant", _ARM):
        raise ValueError(f"with action={command!r} it would change what an action means; draw it with action='force'")
    if command == "voltage" and part == "controller" and field != "substeps":
        raise ValueError("with action='voltage' the command goes past the controller")
    if name in _WHOLE:
        kind = _WHOLE[name]
        if not isinstance(distribution, Choice) or any(type(value) is not kind for value in distribution.values):
            raise ValueError(f"{name} must be drawn from a Choice of {kind.__name__} values")
    elif any(isinstance(value, bool) for value in distribution.extremes):
        raise ValueError(f"{name} must be a number")
    for value in distribution.extremes:
        dataclasses.replace(getattr(actuator, part), **{field: value})  # the field's own bounds
