"""Motors and models drawn at every reset: what is drawn of them, and what present episodes were drawn with."""

import copy
import random
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import mujoco
import numpy as np

from codrl_mj.actuators import (
    BUILT_IN,
    ActuatorModel,
    DCMotorActuator,
    Family,
    Ideal,
    UnstableError,
    choices_of,
    field_paths,
    field_values,
    from_array,
    parameter_paths,
)
from codrl_mj.engine.reading import check_shafts, sharing
from codrl_mj.engine.specs import matched_by, names_of
from codrl_mj.envs.distributions import MODEL, Choice, Distribution, split_path
from codrl_mj.fields import did_you_mean
from codrl_mj.physics.variation import Variation, arms_and_additions, joint_addresses, variable_names, write_fields

MAX_CORNERS = 32
"""Combinations of bounds that are checked: all of five drawn values, and of more so many at random."""
LIMIT = 1000
"""Draws of an unstable loop in a row after which a reset gives up."""
Uniforms = Callable[[np.ndarray, int], np.ndarray]
"""(simulations (m,), count) -> the next `count` numbers in [0, 1) of each of their generators, shape (m, count)."""


class Randomization:
    """What is drawn at a reset, and what it does to motors and model; never changed once it is made."""

    def __init__(
        self,
        distributions: Mapping[str, Distribution],
        model: mujoco.MjModel,
        motors: Mapping[int, ActuatorModel],
        fixed: Sequence[Mapping[str, str]],
        timestep: float,
        allow_unstable: bool,
        whose: str,
    ) -> None:
        """Check the distributions, drawn in their order, against the fields that they are for.

        The `model` is without what its `motors`, by the indices of their actuators, add; `fixed`
        are the fields of each that cannot be drawn, with the reason; motors must be stable at the
        `timestep` [s] unless `allow_unstable`; messages call the model `whose`.
        """
        self.distributions, self.timestep, self.allow_unstable = (
            distributions,
            timestep,
            allow_unstable,
        )
        matched, simulated = (
            _matched(distributions, model, motors, fixed, whose),
            list(motors.values()),
        )
        turned, added = (
            [
                path
                for path, own in matched.items()
                if any(_follows(of, simulated[at], path) for at in own)
            ]
            for of in (lambda one: one.arm_radius, lambda one: one.additions)
        )
        of_model = [path for path, own in matched.items() if not own]
        self.types = {
            path: _kind(type(simulated[own[0]]), path) if own else float
            for path, own in matched.items()
        }
        """Path -> float, int or bool."""
        self.families: list[Family] = list(map(type, simulated))
        """Of each motor of a simulation."""
        self.columns = [
            {
                column: split_path(path)[1]
                for column, (path, own) in enumerate(matched.items())
                if at in own
            }
            for at in range(len(simulated))
        ]
        """Of each motor: column of the drawn values -> the field that it is."""
        self.in_model = (*of_model, *added)
        """The paths that the model, besides its motors' parameters, depends on."""
        self.variation = (
            Variation(model, of_model, list(motors), vary_additions=bool(added))
            if self.in_model
            else None
        )
        """What drawn fields do to the model; None if they do nothing."""
        self.mounting = bool(turned or added)
        """Whether motors' arms, or what they add to the model, depend on what is drawn."""
        self.draws_actuator = any(self.columns)
        """Whether a field of a motor is drawn, and so its stability must be checked at every draw."""
        drawn = zip(self.families, self.columns, strict=True)
        self.random = any({*columns.values()} & {*family.RANDOM} for family, columns in drawn)
        """Whether motors may need an episode's key of random numbers for what is drawn of them."""


class RandomizationState:
    """The drawn values of N simulations, as arrays, and their way into these; a single environment has one.

    Where nothing is drawn, it has nothing to say and nothing to keep.
    """

    def __init__(
        self,
        randomization: Randomization,
        motors: Sequence[Sequence[ActuatorModel]],
        put: "Callable[[RandomizationState, np.ndarray], None]",
    ) -> None:
        """Begin with nothing drawn for simulations with these nominal motors.

        `put` gives some simulations (m,) what they were drawn with, before they are reset or
        restored.
        """
        self.randomization, self._put = randomization, put
        self._motors = motors
        self._nominal = [
            np.array(list(map(field_values, each))) for each in zip(*motors, strict=True)
        ]
        """Fields of each motor, shape (N, f), columns as in `field_paths`."""
        self._mounting = arms_and_additions(motors)
        self._values = np.full((len(motors), len(randomization.distributions)), np.nan)
        self._rejected = np.zeros(len(motors), dtype=np.int64)

    def draw_one(self, generator: np.random.Generator) -> None:
        """Draw anew for the only simulation."""
        self.draw(lambda rows, count: generator.random((len(rows), count)), np.zeros(1, dtype=int))

    def draw(self, random: Uniforms, rows: np.ndarray) -> None:
        """Draw anew for the simulations `rows` (m,), which are to be reset afterwards.

        Whole sets are redrawn until their motors are stable.
        """
        drawn = self.randomization
        if not drawn.distributions:
            return
        values, rejected = (
            np.empty((len(rows), len(drawn.distributions))),
            np.zeros(len(rows), dtype=np.int64),
        )
        pending = np.arange(len(rows))
        while len(pending):
            draws = random(rows[pending], len(drawn.distributions))
            for column, distribution in enumerate(drawn.distributions.values()):
                values[pending, column] = distribution.transform(draws[:, column].copy())
            if drawn.allow_unstable or not drawn.draws_actuator:
                break
            unstable, fields = (
                np.zeros(len(pending), dtype=bool),
                self._fields(rows[pending], values[pending]),
            )
            for family, columns, each in zip(drawn.families, drawn.columns, fields, strict=True):
                if columns:
                    unstable |= ~(
                        family.instability(numbers_of(family, each), drawn.timestep) < 1.0
                    )
            pending = pending[unstable]
            rejected[pending] += 1
            if len(pending) and rejected[pending[0]] == LIMIT:
                raise ValueError(
                    f"randomize: {LIMIT} draws in a row have an unstable current loop at a step of"
                    f" {drawn.timestep:g} s; the last was"
                    f" {self._last(rows[pending[:1]], values[pending[:1]])}. Narrow the bounds,"
                    " shorten the step, or pass allow_unstable=True"
                )
        self._values[rows], self._rejected[rows] = values, rejected
        self._put(self, rows)

    def _last(self, row: np.ndarray, values: np.ndarray) -> str:
        """What a simulation was drawn with, and what the first refused motor says of itself."""
        drawn = self.randomization
        last = str(dict(zip(drawn.distributions, values[0].tolist(), strict=True)))
        for family, each in zip(drawn.families, self._fields(row, values), strict=True):
            try:
                family.from_parameter_values(numbers_of(family, each)[0]).check(drawn.timestep)
            except ValueError as error:
                return f"{last}: {error}"
        return last

    def _fields(self, rows: np.ndarray, values: np.ndarray) -> list[np.ndarray]:
        """The fields of some simulations' motors, each (m, f), with drawn values (m, k) for theirs; NaN leaves them."""
        fields, drawn = [each[rows] for each in self._nominal], self.randomization
        for family, columns, each in zip(drawn.families, drawn.columns, fields, strict=True):
            for column, field in columns.items():
                place, new = field_paths(family).index(field), values[:, column]
                each[:, place] = np.where(np.isnan(new), each[:, place], new)
        return fields

    def motors(
        self, row: int = 0, nominal: Sequence[ActuatorModel] | None = None
    ) -> tuple[ActuatorModel, ...]:
        """What is drawn of a simulation's motors, or of others in their place."""
        nominal, values = self._motors[row] if nominal is None else nominal, self._values[row]
        if not len(values) or np.isnan(values).any():
            return tuple(nominal)
        changes = (
            {field: float(values[column]) for column, field in columns.items()}
            for columns in self.randomization.columns
        )
        return tuple(one.replaced(new) for one, new in zip(nominal, changes, strict=True))

    def parameters(self, rows: np.ndarray) -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
        """Of some simulations' motors: the numbers of each (m, p), arms [m] (m, n), and additions (m, n, 3)."""
        fields, families = self._fields(rows, self._values[rows]), self.randomization.families
        arms, additions = (each[rows] for each in self._mounting)
        if self.randomization.mounting:
            each = zip(*(one.tolist() for one in fields), strict=True)
            arms, additions = arms_and_additions(
                [list(map(from_array, families, values)) for values in each]
            )
        return list(map(numbers_of, families, fields)), arms, additions

    def model_fields(
        self, rows: np.ndarray, additions: np.ndarray | None = None, shown: bool = False
    ) -> dict[str, np.ndarray]:
        """The drawn fields of some simulations' models; see `Variation.fields`."""
        variation = self.randomization.variation
        if variation is None:
            return {}
        additions = self.parameters(rows)[2] if additions is None else additions
        names = list(self.randomization.distributions)
        columns = np.array([names.index(name) for name in variation.names], dtype=int)
        return variation.fields(self._values[np.ix_(rows, columns)], additions, shown)

    def report(self, row: int = 0) -> dict[str, Any]:
        """What `info` says of a simulation's draw: values by field, those of a pattern together; NaN before one."""
        found: dict[str, Any] = {}
        for (path, kind), value in zip(
            self.randomization.types.items(), self._values[row], strict=True
        ):
            pattern, field = split_path(path)
            (found.setdefault(pattern, {}) if pattern else found)[field] = (
                np.nan if np.isnan(value) else kind(value)
            )
        return found | {"rejected": int(self._rejected[row])} if found else {}

    def infos(self, rows: np.ndarray) -> dict[str, Any]:
        """The same of a vector environment's simulations, as Gymnasium's vector infos: nested, with masks."""
        if not self.randomization.distributions:
            return {}
        mask = np.zeros(len(self._values), dtype=bool)
        mask[rows] = True
        report: dict[str, Any] = {}
        for name, column in self.present().items():
            kind = self.randomization.types.get(name, int)
            report[name] = np.zeros(len(mask), dtype=kind)
            report[name][rows] = column[rows]
            report[f"_{name}"] = mask.copy()
        return {"randomization": report, "_randomization": mask}

    def present(self) -> dict[str, np.ndarray]:
        """The values in use by path, and the number of rejected sets, each of shape (N,); NaN before a reset."""
        columns = dict(zip(self.randomization.distributions, self._values.T.copy(), strict=True))
        return columns | {"rejected": self._rejected.copy()} if columns else {}

    def snapshot(self) -> dict[str, np.ndarray]:
        """What `restore` needs."""
        kept = {"drawn": self._values.copy(), "rejected": self._rejected.copy()}
        return kept if self.randomization.distributions else {}

    def restore(self, snapshot: Mapping[str, np.ndarray]) -> None:
        """Bring back the values, and the simulations to them; to be followed by a restoring of the simulations."""
        if self.randomization.distributions:
            self._values[:], self._rejected[:] = snapshot["drawn"], snapshot["rejected"]
            self._put(self, np.arange(len(self._values)))


def check_extremes(
    randomization: Randomization,
    motors: Mapping[int, ActuatorModel],
    model: mujoco.MjModel,
    held: bool = False,
    explicit: bool = False,
) -> None:
    """Refuse draws that can make a loop over a position or a speed unstable, by combinations of their bounds.

    Args:
        randomization: what is drawn.
        motors: the motors as they are, by the indices of their actuators.
        model: the model with them; it is not changed.
        held: as for `check_shafts`.
        explicit: likewise.

    Raises:
        ValueError: with the values that were tried, and a remedy.
    """
    if not randomization.distributions or not any(
        one.MOTION or type(one) not in BUILT_IN for one in motors.values()
    ):
        return
    draws, model = (
        RandomizationState(randomization, [list(motors.values())], lambda *_: None),
        copy.copy(model),
    )
    data, bounds = (
        mujoco.MjData(model),
        [sorted(one.extremes) for one in randomization.distributions.values()],
    )
    count = 2 ** len(bounds)
    for corner in (
        range(count) if count <= MAX_CORNERS else random.Random(0).sample(range(count), MAX_CORNERS)
    ):
        values = [each[-(corner >> column & 1)] for column, each in enumerate(bounds)]
        draws._values[0] = values
        try:
            present = dict(zip(motors, draws.motors(), strict=True))
            for index, one in present.items():
                one.check(randomization.timestep)
                if model.actuator_plugin[index] < 0:  # the callback's arm is in the gear
                    model.actuator_gear[model.actuator_outadr[index], 0] = 1.0 / one.arm_radius
        except ValueError:
            continue  # Such a set is drawn again.
        write_fields(model, draws.model_fields(np.zeros(1, dtype=int)))
        mujoco.mj_setConst(model, data)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                check_shafts(model, held=held, actuators=present, explicit=explicit)
        except UnstableError as error:
            drawn = ", ".join(
                f"{path} = {value:g}"
                for path, value in zip(randomization.types, values, strict=True)
            )
            raise ValueError(f"randomize: {drawn}: {error}; or narrow the bounds") from None


def apply_to_simulation(simulation: Any, draws: RandomizationState, rows: np.ndarray) -> None:
    """Give the only simulation, of a `Physics` or of `ActuatorBank`, what was drawn."""
    if draws.randomization.draws_actuator:
        simulation.set_actuators(draws.motors())
    if draws.randomization.variation is not None:
        simulation.set_model(draws.model_fields(rows, shown=True))


def apply_to_batch(physics: Any, draws: RandomizationState, rows: np.ndarray) -> None:
    """Give simulations of a `MujocoBatchPhysics`, whose motors are of one family, what they were drawn with."""
    numbers, arms, additions = draws.parameters(rows)
    if draws.randomization.draws_actuator:
        physics.set_parameters(rows, np.stack(numbers, axis=1), arms)
    if draws.randomization.variation is not None:
        physics.set_model(rows, draws.model_fields(rows, additions))


def numbers_of(family: Family, fields: np.ndarray) -> np.ndarray:
    """The numbers, shape (m, p), of motors with the given fields (m, f)."""
    paths = field_paths(family)
    return fields[:, [paths.index(path) for path in parameter_paths(family).values()]]


def _matched(
    distributions: Mapping[str, Distribution],
    model: mujoco.MjModel,
    motors: Mapping[int, ActuatorModel],
    fixed: Sequence[Mapping[str, str]],
    whose: str,
) -> dict[str, list[int]]:
    """Path -> which of the motors, in their order, it is drawn of, checked; none if it is the model's."""
    indices, simulated, varied = (
        list(motors),
        list(motors.values()),
        variable_names(model) if distributions else (),
    )
    names, rubbing = names_of(model), [joint_addresses(model, index)[2] is not None for index in motors]
    called = [[name for one in sharing(model, index) for name in names[one]] for index in indices]
    matched: dict[str, list[int]] = {}
    for path, distribution in distributions.items():
        pattern, field = split_path(path)
        try:
            every = list(range(len(indices)))
            own = (
                [] if field.startswith(MODEL) else matched_by(pattern, called) if pattern else every
            )
            _check_known(field, [simulated[at] for at in own], varied, whose)
            if any(
                split_path(other)[1] == field and {*own} & {*those}
                for other, those in matched.items()
            ):
                raise ValueError("it is drawn by another pattern, too")
            if not own:
                _check_factor(field, distribution)
            for at in own:
                _check(field, distribution, simulated[at], fixed[at])
                if not rubbing[at] and _follows(
                    lambda one: one.additions.friction, simulated[at], field
                ):
                    raise ValueError(
                        f"{model.actuator(indices[at]).name or f'actuator {indices[at]}'} drives"
                        " neither a joint nor a tendon, which the friction that is drawn for its"
                        " motor would need; draw other fields"
                    )
        except ValueError as error:
            label = f"[{pattern!r}]" * bool(pattern) + f"[{field!r}]"
            raise ValueError(f"randomize{label} = {distribution}: {error}") from None
        matched[path] = own
    return matched


def _check_known(
    field: str, motors: Sequence[ActuatorModel], varied: Sequence[str], whose: str
) -> None:
    """Refuse a name that is no field of all these motors, nor of the model."""
    families: list[Family] = [
        DCMotorActuator if isinstance(one, Ideal) else type(one) for one in motors
    ]
    of_each = [field_paths(family) for family in families]
    known = [
        path for path in (of_each[0] if of_each else ()) if all(path in paths for paths in of_each)
    ]
    known += varied
    if field not in known:
        raise ValueError(
            f"unknown field {field!r}: {did_you_mean(field, known)}{whose} has {', '.join(known)}"
        )


def _check_factor(field: str, distribution: Distribution) -> None:
    """Refuse what the model cannot be multiplied by, or have added to it."""
    low, kind = min(distribution.extremes), field.split(".")[1]
    allowed_zero = kind in ("gravity", "damping")
    if (
        not np.isfinite(distribution.extremes).all()
        or low < 0.0
        or (low == 0.0 and not allowed_zero)
    ):
        raise ValueError(
            f"{field} = {low:g}: must be a finite number {'>=' if allowed_zero else '>'} 0"
        )


def _check(
    field: str, distribution: Distribution, motor: ActuatorModel, fixed: Mapping[str, str]
) -> None:
    """Refuse what cannot be drawn of a motor."""
    if isinstance(motor, Ideal):
        raise ValueError(
            "the ideal actuator has no motor and no controller to draw; choose another actuator"
        )
    if field in fixed:
        raise ValueError(f"{fixed[field]}; draw it with action='force'")
    kind, words = _kind(type(motor), field), choices_of(type(motor), field)
    if words:
        if not isinstance(distribution, Choice) or any(
            value not in range(len(words)) for value in distribution.values
        ):
            numbered = ", ".join(f"{place} for {word}" for place, word in enumerate(words))
            raise ValueError(f"{field} is a word: draw it from a Choice of {numbered}")
    elif kind is not float:
        if not isinstance(distribution, Choice) or any(
            type(value) is not kind for value in distribution.values
        ):
            raise ValueError(f"{field} must be drawn from a Choice of {kind.__name__} values")
    elif any(isinstance(value, bool) for value in distribution.extremes):
        raise ValueError(f"{field} must be a number")
    for value in distribution.extremes:
        motor.replaced({field: value})  # the field's own bounds


def _kind(family: Family, path: str) -> type:
    """What a field of a family holds: float, int or bool."""
    value: Any = family()
    for part in split_path(path)[1].split("."):
        value = getattr(value, part, None)
    return type(value) if isinstance(value, int) else float


def _follows(of: Callable[[ActuatorModel], Any], motor: ActuatorModel, path: str) -> bool:
    """Whether something of a motor depends on a field: at the motor's values, or where no other field is 0."""
    family: Family = type(motor)
    fields, field = field_paths(family), split_path(path)[1]
    for values in (field_values(motor), (2.0,) * len(fields)):
        other = [value + (name == field) for name, value in zip(fields, values, strict=True)]
        if of(from_array(family, values)) != of(from_array(family, other)):
            return True
    return False
