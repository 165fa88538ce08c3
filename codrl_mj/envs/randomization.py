"""Randomization of motors and models at every reset: the distributions, and the drawn values."""

import copy
import random
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Protocol

import mujoco
import numpy as np

from codrl_mj.actuators import (
    BUILT_IN,
    ActuatorModel,
    DCMotorActuator,
    Family,
    Ideal,
    UnstableError,
    field_paths,
    field_values,
    from_array,
    parameter_paths,
)
from codrl_mj.boundary import Info
from codrl_mj.engine.matching import match_pattern, matchable_names
from codrl_mj.engine.mounting import joint_addresses, set_arm_in_gear
from codrl_mj.engine.reading import actuators_sharing_motor, check_shafts
from codrl_mj.envs.distributions import MODEL, Distribution, split_pattern
from codrl_mj.envs.motor_fields import check_motor_field, depends_on, type_of_field
from codrl_mj.fields import did_you_mean
from codrl_mj.physics.mujoco_batch import MujocoBatchPhysics
from codrl_mj.physics.variation import (
    Variation,
    arms_and_additions,
    variable_names,
    write_fields,
)

MAX_CORNERS = 32
"""Maximum number of combinations of bounds to check; if there are more, a sample is checked."""
MAX_REDRAWS = 1000
"""Number of consecutive draws with an unstable current loop after which a reset fails."""
Uniforms = Callable[[np.ndarray, int], np.ndarray]
"""(simulations (m,), count) -> the next `count` draws in [0, 1) of each, shape (m, count)."""


class VariableSimulation(Protocol):
    """Simulation whose motors and model can be replaced before a reset."""

    def set_actuators(self, actuators: Sequence[ActuatorModel]) -> None:
        """Replace the motors by others of their families."""

    def set_model(self, fields: Mapping[str, np.ndarray]) -> None:
        """Write fields of the model, as `Variation.fields` returns them."""


class Randomization:
    """Distributions of a simulation's fields and their effect on motors and model; immutable."""

    def __init__(
        self,
        distributions: Mapping[str, Distribution],
        model: mujoco.MjModel,
        motors: Mapping[int, ActuatorModel],
        fixed: Sequence[Mapping[str, str]],
        timestep: float,
        allow_unstable: bool,
        model_name: str,
    ) -> None:
        """Check that motors and model have the distributions' fields, and allow their values.

        Args:
            distributions: path -> distribution, in the order of drawing.
            model: the model without its motors' additions (`JointAdditions`).
            motors: actuator index -> motor.
            fixed: for each motor, fields that cannot be drawn -> reason.
            timestep: integration step [s] at which drawn motors must be stable.
            allow_unstable: True to accept unstable motors.
            model_name: name of the model in messages.
        """
        self.distributions, self.timestep, self.allow_unstable = (
            distributions,
            timestep,
            allow_unstable,
        )
        matched, actuators = (
            _match_motors(distributions, model, motors, fixed, model_name),
            list(motors.values()),
        )
        arm_paths, addition_paths = (
            [
                path
                for path, motor_indices in matched.items()
                if any(
                    depends_on(quantity, actuators[motor_index], path)
                    for motor_index in motor_indices
                )
            ]
            for quantity in (
                lambda actuator: actuator.arm_radius,
                lambda actuator: actuator.additions,
            )
        )
        model_only_paths = [path for path, motor_indices in matched.items() if not motor_indices]
        self.types = {
            path: type_of_field(type(actuators[motor_indices[0]]), path) if motor_indices else float
            for path, motor_indices in matched.items()
        }
        """Path -> type of the field: float, int or bool."""
        self.families: list[Family] = list(map(type, actuators))
        """Family of each motor of a simulation."""
        self.columns = [
            {
                column: split_pattern(path)[1]
                for column, (path, motor_indices) in enumerate(matched.items())
                if motor_index in motor_indices
            }
            for motor_index in range(len(actuators))
        ]
        """For each motor: column of the drawn values -> name of the field."""
        self.model_paths = (*model_only_paths, *addition_paths)
        """Paths that change the model itself, and not only parameters of its motors."""
        self.variation = (
            Variation(model, model_only_paths, list(motors), vary_additions=bool(addition_paths))
            if self.model_paths
            else None
        )
        """Effect of the drawn fields on the model; None if only motors' parameters change."""
        self.changes_mounting = bool(arm_paths or addition_paths)
        """True if motors' arms, or what they add to the model, depend on drawn values."""
        self.draws_actuator = any(self.columns)
        """True if a motor's field is drawn, so that each draw must be checked for stability."""
        family_columns = zip(self.families, self.columns, strict=True)
        self.may_need_key = any(
            {*columns.values()} & {*family.RANDOM} for family, columns in family_columns
        )
        """True if drawn values may make motors need a random key."""


class RandomizationState:
    """The drawn values of N simulations, as arrays; a single environment has N = 1.

    All methods are no-ops if nothing is randomized.
    """

    def __init__(
        self,
        randomization: Randomization,
        motors: Sequence[Sequence[ActuatorModel]],
        apply_values: "Callable[[RandomizationState, np.ndarray], None]",
    ) -> None:
        """Start without drawn values for simulations with these nominal motors.

        `apply_values` writes the drawn values into the simulations with given indices (m,). It is
        called before they are reset or restored.
        """
        self.randomization, self._apply_values = randomization, apply_values
        self._motors = motors
        self._nominal = [
            np.array(list(map(field_values, fields))) for fields in zip(*motors, strict=True)
        ]
        """Fields of each motor, shape (N, f), columns as in `field_paths`."""
        self._mounting = arms_and_additions(motors)
        self._values = np.full((len(motors), len(randomization.distributions)), np.nan)
        self._rejected = np.zeros(len(motors), dtype=np.int64)

    def draw_single(self, generator: np.random.Generator) -> None:
        """Draw new values for the only simulation."""
        self.draw(lambda rows, count: generator.random((len(rows), count)), np.zeros(1, dtype=int))

    def draw(self, draw_uniforms: Uniforms, rows: np.ndarray) -> None:
        """Draw new values for the simulations `rows` (m,); they must be reset afterwards.

        A set of values with an unstable motor is drawn again as a whole.
        """
        randomization = self.randomization
        if not randomization.distributions:
            return
        values, rejected = (
            np.empty((len(rows), len(randomization.distributions))),
            np.zeros(len(rows), dtype=np.int64),
        )
        pending = np.arange(len(rows))
        while len(pending):
            draws = draw_uniforms(rows[pending], len(randomization.distributions))
            for column, distribution in enumerate(randomization.distributions.values()):
                # A contiguous copy, because numpy may round strided arrays differently: a draw must
                # give the same value in any batch.
                values[pending, column] = distribution.transform(draws[:, column].copy())
            if randomization.allow_unstable or not randomization.draws_actuator:
                break
            unstable, fields = (
                np.zeros(len(pending), dtype=bool),
                self._fields(rows[pending], values[pending]),
            )
            for family, columns, motor_fields in zip(
                randomization.families, randomization.columns, fields, strict=True
            ):
                if columns:
                    unstable |= ~(
                        family.instability(
                            parameters_from_fields(family, motor_fields), randomization.timestep
                        )
                        < 1.0
                    )
            # Only simulations whose last set was unstable are drawn again and checked again.
            pending = pending[unstable]
            rejected[pending] += 1
            if len(pending) and rejected[pending[0]] == MAX_REDRAWS:
                raise ValueError(
                    f"randomize: {MAX_REDRAWS} draws in a row have an unstable current loop at a"
                    f" step of {randomization.timestep:g} s; the last was"
                    f" {self._describe_last_set(rows[pending[:1]], values[pending[:1]])}. Narrow"
                    " the bounds, shorten the step, or pass allow_unstable=True"
                )
        self._values[rows], self._rejected[rows] = values, rejected
        self._apply_values(self, rows)

    def _describe_last_set(self, row: np.ndarray, values: np.ndarray) -> str:
        """Describe a simulation's drawn values, with the error of the first unstable motor."""
        randomization = self.randomization
        description = str(dict(zip(randomization.distributions, values[0].tolist(), strict=True)))
        for family, motor_fields in zip(
            randomization.families, self._fields(row, values), strict=True
        ):
            try:
                family.from_parameter_values(parameters_from_fields(family, motor_fields)[0]).check(
                    randomization.timestep
                )
            except ValueError as error:
                return f"{description}: {error}"
        return description

    def _fields(self, rows: np.ndarray, values: np.ndarray) -> list[np.ndarray]:
        """Return the motors' fields (m, f) with drawn values (m, k); NaN leaves a field nominal."""
        fields, randomization = (
            [motor_fields[rows] for motor_fields in self._nominal],
            self.randomization,
        )
        for family, columns, motor_fields in zip(
            randomization.families, randomization.columns, fields, strict=True
        ):
            for column, field in columns.items():
                field_index, drawn_values = field_paths(family).index(field), values[:, column]
                motor_fields[:, field_index] = np.where(
                    np.isnan(drawn_values), motor_fields[:, field_index], drawn_values
                )
        return fields

    def motors(
        self, row: int = 0, nominal: Sequence[ActuatorModel] | None = None
    ) -> tuple[ActuatorModel, ...]:
        """Return a simulation's motors with drawn values instead of those of `nominal`."""
        nominal, values = self._motors[row] if nominal is None else nominal, self._values[row]
        if not len(values) or np.isnan(values).any():
            return tuple(nominal)
        all_changes = (
            {field: float(values[column]) for column, field in columns.items()}
            for columns in self.randomization.columns
        )
        return tuple(
            actuator.replaced(changes)
            for actuator, changes in zip(nominal, all_changes, strict=True)
        )

    def parameters(self, rows: np.ndarray) -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
        """Return the motors' parameters, each (m, p), arms [m] (m, n), and additions (m, n, 3)."""
        fields, families = self._fields(rows, self._values[rows]), self.randomization.families
        arms, additions = (array[rows] for array in self._mounting)
        if self.randomization.changes_mounting:
            simulations = zip(*(motor_fields.tolist() for motor_fields in fields), strict=True)
            arms, additions = arms_and_additions(
                [list(map(from_array, families, values)) for values in simulations]
            )
        return list(map(parameters_from_fields, families, fields)), arms, additions

    def model_fields(
        self, rows: np.ndarray, additions: np.ndarray | None = None, shown: bool = False
    ) -> dict[str, np.ndarray]:
        """Return the drawn fields of some simulations' models; see `Variation.fields`."""
        variation = self.randomization.variation
        if variation is None:
            return {}
        additions = self.parameters(rows)[2] if additions is None else additions
        names = list(self.randomization.distributions)
        columns = np.array([names.index(name) for name in variation.names], dtype=int)
        return variation.fields(self._values[np.ix_(rows, columns)], additions, shown)

    def nominal_fields(self) -> dict[str, np.ndarray]:
        """Return the first model's varied fields without drawn values, shape (1, ...)."""
        variation = self.randomization.variation
        if variation is None:
            return {}
        no_values = np.full((1, len(variation.names)), np.nan)
        return variation.fields(no_values, self._mounting[1][:1], shown=True)

    def report(self, row: int = 0) -> Info:
        """Return a simulation's drawn values for `info`, grouped by pattern; NaN before a reset."""
        report: Info = {}
        for (path, field_type), value in zip(
            self.randomization.types.items(), self._values[row], strict=True
        ):
            pattern, field = split_pattern(path)
            (report.setdefault(pattern, {}) if pattern else report)[field] = (
                np.nan if np.isnan(value) else field_type(value)
            )
        return report | {"rejected": int(self._rejected[row])} if report else {}

    def infos(self, rows: np.ndarray) -> Info:
        """Return the drawn values as Gymnasium's vector infos: nested, with masks."""
        if not self.randomization.distributions:
            return {}
        mask = np.zeros(len(self._values), dtype=bool)
        mask[rows] = True
        report: Info = {}
        for name, column in self.drawn_values().items():
            value_type = self.randomization.types.get(name, int)
            report[name] = np.zeros(len(mask), dtype=value_type)
            report[name][rows] = column[rows]
            report[f"_{name}"] = mask.copy()
        return {"randomization": report, "_randomization": mask}

    def drawn_values(self) -> dict[str, np.ndarray]:
        """Return path -> present values, shape (N,), and the number of rejected sets."""
        columns = dict(zip(self.randomization.distributions, self._values.T.copy(), strict=True))
        return columns | {"rejected": self._rejected.copy()} if columns else {}

    def snapshot(self) -> dict[str, np.ndarray]:
        """Return the state that `restore` needs."""
        state = {"drawn": self._values.copy(), "rejected": self._rejected.copy()}
        return state if self.randomization.distributions else {}

    def restore(self, snapshot: Mapping[str, np.ndarray]) -> None:
        """Restore the values and apply them; the simulations must be restored afterwards."""
        if self.randomization.distributions:
            self._values[:], self._rejected[:] = snapshot["drawn"], snapshot["rejected"]
            self._apply_values(self, np.arange(len(self._values)))


def check_extremes(
    randomization: Randomization,
    motors: Mapping[int, ActuatorModel],
    model: mujoco.MjModel,
    held: bool = False,
    explicit: bool = False,
) -> None:
    """Raise if a combination of the distributions' bounds makes a position or speed loop unstable.

    Args:
        randomization: the distributions.
        motors: actuator index -> nominal motor.
        model: the model with these motors; it is not changed.
        held: see `check_shafts`.
        explicit: see `check_shafts`.

    Raises:
        ValueError: a combination is unstable; the message has the values and a remedy.
    """
    if not randomization.distributions or not any(
        actuator.MOTION or type(actuator) not in BUILT_IN for actuator in motors.values()
    ):
        return
    state, model = (
        RandomizationState(randomization, [list(motors.values())], lambda *_: None),
        copy.copy(model),
    )
    data, bounds = (
        mujoco.MjData(model),
        [sorted(distribution.extremes) for distribution in randomization.distributions.values()],
    )
    count = 2 ** len(bounds)
    for corner in (
        range(count) if count <= MAX_CORNERS else random.Random(0).sample(range(count), MAX_CORNERS)
    ):
        # Bit `column` of `corner` selects the first or the last of the field's values: [0] or [-1].
        values = [extremes[-(corner >> column & 1)] for column, extremes in enumerate(bounds)]
        state._values[0] = values
        try:
            actuators = dict(zip(motors, state.motors(), strict=True))
            for index, actuator in actuators.items():
                actuator.check(randomization.timestep)
                set_arm_in_gear(model, index, actuator)
        except ValueError:
            # A reset rejects such values and draws again, so they are no error.
            continue
        write_fields(model, state.model_fields(np.zeros(1, dtype=int)))
        mujoco.mj_setConst(model, data)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                check_shafts(model, held=held, actuators=actuators, explicit=explicit)
        except UnstableError as error:
            drawn_values = ", ".join(
                f"{path} = {value:g}"
                for path, value in zip(randomization.types, values, strict=True)
            )
            raise ValueError(f"randomize: {drawn_values}: {error}; or narrow the bounds") from None


def apply_to_simulation(
    simulation: VariableSimulation, state: RandomizationState, rows: np.ndarray
) -> None:
    """Write the drawn values into the only simulation of a `Physics` or an `ActuatorBank`."""
    if state.randomization.draws_actuator:
        simulation.set_actuators(state.motors())
    if state.randomization.variation is not None:
        simulation.set_model(state.model_fields(rows, shown=True))


def apply_to_batch(
    physics: MujocoBatchPhysics, state: RandomizationState, rows: np.ndarray
) -> None:
    """Write the drawn values into a `MujocoBatchPhysics`, whose motors are of one family."""
    parameters, arms, additions = state.parameters(rows)
    if state.randomization.draws_actuator:
        physics.set_parameters(rows, np.stack(parameters, axis=1), arms)
    if state.randomization.variation is not None:
        physics.set_model(rows, state.model_fields(rows, additions))


def parameters_from_fields(family: Family, fields: np.ndarray) -> np.ndarray:
    """Return the parameters (m, p) of motors with the given fields (m, f)."""
    paths = field_paths(family)
    return fields[:, [paths.index(path) for path in parameter_paths(family).values()]]


def _match_motors(
    distributions: Mapping[str, Distribution],
    model: mujoco.MjModel,
    motors: Mapping[int, ActuatorModel],
    fixed: Sequence[Mapping[str, str]],
    model_name: str,
) -> dict[str, list[int]]:
    """Return path -> indices of its motors, checked; no indices for a field of the model."""
    indices, actuators, model_fields = (
        list(motors),
        list(motors.values()),
        variable_names(model) if distributions else (),
    )
    names, allows_friction = (
        matchable_names(model),
        [joint_addresses(model, index)[2] is not None for index in motors],
    )
    actuator_names = [
        [name for actuator in actuators_sharing_motor(model, index) for name in names[actuator]]
        for index in indices
    ]
    matched: dict[str, list[int]] = {}
    for path, distribution in distributions.items():
        pattern, field = split_pattern(path)
        try:
            all_motors = list(range(len(indices)))
            motor_indices = (
                []
                if field.startswith(MODEL)
                else match_pattern(pattern, actuator_names)
                if pattern
                else all_motors
            )
            _check_known(
                field,
                [actuators[motor] for motor in motor_indices],
                model_fields,
                model_name,
            )
            if any(
                split_pattern(other_path)[1] == field and {*motor_indices} & {*other_indices}
                for other_path, other_indices in matched.items()
            ):
                raise ValueError("it is drawn by another pattern, too")
            if not motor_indices:
                _check_model_factor(field, distribution)
            for motor in motor_indices:
                check_motor_field(field, distribution, actuators[motor], fixed[motor])
                if not allows_friction[motor] and depends_on(
                    lambda actuator: actuator.additions.friction, actuators[motor], field
                ):
                    raise ValueError(
                        f"{model.actuator(indices[motor]).name or f'actuator {indices[motor]}'}"
                        " drives neither a joint nor a tendon, so its motor cannot have the"
                        " friction that is drawn; draw other fields"
                    )
        except ValueError as error:
            label = f"[{pattern!r}]" * bool(pattern) + f"[{field!r}]"
            raise ValueError(f"randomize{label} = {distribution}: {error}") from None
        matched[path] = motor_indices
    return matched


def _check_known(
    field: str, motors: Sequence[ActuatorModel], model_fields: Sequence[str], model_name: str
) -> None:
    """Raise unless all of these motors, or the model, have a field of this name."""
    families: list[Family] = [
        DCMotorActuator if isinstance(actuator, Ideal) else type(actuator) for actuator in motors
    ]
    paths_of_families = [field_paths(family) for family in families]
    known = [
        path
        for path in (paths_of_families[0] if paths_of_families else ())
        if all(path in paths for paths in paths_of_families)
    ]
    known += model_fields
    if field not in known:
        raise ValueError(
            f"unknown field {field!r}: {did_you_mean(field, known)}{model_name} has"
            f" {', '.join(known)}"
        )


def _check_model_factor(field: str, distribution: Distribution) -> None:
    """Raise if a distribution has values out of the model field's bounds."""
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
