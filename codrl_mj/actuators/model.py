"""Base class of actuators: a frozen dataclass of numbers with one pure function, `advance`.

A *family* of actuators is a subclass of `ActuatorModel`, in one file. Everything else in the
package reads the family's class: the two MuJoCo backends, the analytic physics, configuration
files, the command line, randomization, `info`, films and evaluations. docs/actuators.md builds an
example.
"""

import dataclasses
import functools
import hashlib
import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np

from codrl_mj import fields
from codrl_mj.actuators.parameters import (
    FieldValue,
    Parameters,
    family_of,
    field_paths,
    from_values,
    is_arm,
    parameter_paths,
    parameters_type,
    to_field_type,
    value_at,
)
from codrl_mj.user_code import Form, call, check_form, source_location


class Inputs(NamedTuple):
    """Inputs of an actuator in one mechanical step, held constant over the step."""

    desired_torque: float
    """Desired torque at the shaft [N*m], or force [N]; for a family with `MOTION` the commanded
    position [rad, m] or speed; for an agent that commands the voltage u, kT*u.
    """
    position: float
    """Position of the shaft at the beginning of the step [rad] or [m]."""
    speed: float
    """Speed of the shaft at the beginning of the step [rad/s] or [m/s]."""
    time: float
    """Time since the start of the episode [s], at the beginning of the step."""
    noise_key: float
    """Key of the episode's random numbers, a whole number: see `codrl_mj.actuators.noise`."""
    inertia: float = math.inf
    """Total inertia at the shaft [kg*m^2], or mass [kg], of everything that the actuator moves in
    the model, for the state at the beginning of the step; `inf` for families without `INERTIA` and
    where it is unknown.
    """


# Each family declares its own named tuples, and reads them by name. A method that overrides another
# must accept what the other accepts, so the arguments of the base class have no narrower type.
FamilyTuple = Any
"""`State` or `Signals` of a family."""


class UnstableError(ValueError):
    """An actuator is unstable at the given time step; `allow_unstable=True` simulates it anyway."""


class Empty(NamedTuple):
    """Empty named tuple, for families without states or without signals."""


class Command(NamedTuple):
    """Alternative meaning of an agent's action, for example a current or a voltage."""

    unit: str
    """Unit of the command, for messages."""
    actuator: "ActuatorModel"
    """Simulated actuator: a copy without the control loops that the command bypasses."""
    torque_per_unit: float
    """Torque [N*m] at the shaft that corresponds to a command of one unit."""
    limit: float | None
    """Largest command; None: the command that corresponds to the task's largest force."""
    fixed: Mapping[str, str]
    """Fields that must not be randomized, with the reason for each."""


class JointAdditions(NamedTuple):
    """Quantities that an actuator adds to the joint that it drives."""

    armature: float = 0.0
    """Inertia [kg*m^2], or mass [kg]."""
    damping: float = 0.0
    """Viscous friction [N*m*s/rad], or [N*s/m]."""
    friction: float = 0.0
    """Coulomb friction [N*m], or [N]."""


FAMILIES: dict[str, type["ActuatorModel"]] = {}
"""Built-in families by name. Custom families are referred to as `module:Class`."""
BUILT_IN: list[type["ActuatorModel"]] = []
"""Built-in families, including the nameless ones that their commands simulate."""


@dataclasses.dataclass(frozen=True)
class ActuatorModel(fields.Checked):
    """Base class of all actuator families.

    Fields are created with the functions of `codrl_mj.fields`. A family has a name, declares its
    states and signals as `NamedTuple`s of floats, and defines `advance`. The defaults of all other
    methods suit an actuator without gear and winding, which is stable at any step.

    Raises:
        ValueError: a field is out of bounds.
    """

    family: ClassVar[str] = ""
    """Name of the family in mappings, files and on the command line. Optional: `module:Class` works
    without it.
    """
    State: ClassVar[type[NamedTuple]] = Empty
    """State of the actuator: a `NamedTuple` of floats, all 0 at the start of an episode."""
    Signals: ClassVar[type[NamedTuple]] = Empty
    """Signals after a step: a `NamedTuple` of floats. A signal named `saturated` is 1 while the
    actuator is at a limit; `voltage_saturated`, `current_saturated` and `temperature_saturated`
    tell which limit. Evaluations compute their electrical measures from the signals `current` [A]
    and `voltage` [V].
    """
    SIGNAL_UNITS: ClassVar[Mapping[str, str]] = {}
    """Units of the signals, for tables and figures."""
    OBSERVED: ClassVar[tuple[str, ...]] = ()
    """Names of the values that `observe` returns and `observe_actuator=True` appends to
    observations.
    """
    RANDOM: ClassVar[tuple[str, ...]] = ()
    """Dotted paths of the fields that need the episode's random key if they are not 0."""
    is_torque_controlled: ClassVar[bool] = True
    """True if the command is a torque. If False, `desired_force` equals the delivered force."""
    INERTIA: ClassVar[bool] = False
    """True if `advance` needs the inertia at the shaft. The engine takes some time to compute it.
    """
    SHARES_SUPPLY: ClassVar[bool] = False
    """True if the engine advances all actuators of a supply together; see `shared_drive`."""
    MOTION: ClassVar[bool] = False
    """True if the command is a position [rad] or a speed [rad/s] of the shaft instead of a torque.
    """
    # Families are arguments of cached functions. Mypy compares the instances' `__hash__` with that
    # of the class, and would call the class unhashable without this annotation, which sets nothing.
    __hash__: ClassVar[Callable[..., int]]

    def __init_subclass__(cls, **kwargs: object) -> None:
        """Register a built-in family by its name; custom families are found as `module:Class`."""
        super().__init_subclass__(**kwargs)
        # Validation simulates edited copies of these modules. Their classes have the same import
        # path, and must not replace the originals.
        # A class without `advance` is a base class of families.
        is_family = cls.advance is not ActuatorModel.advance
        if (
            is_family
            and cls.__module__.startswith("codrl_mj.actuators.")
            and import_path(cls) not in map(import_path, BUILT_IN)
        ):
            BUILT_IN.append(cls)
            if name := vars(cls).get("family"):
                FAMILIES[name] = cls

    def __post_init__(self) -> None:
        """Validate."""
        super().__post_init__()
        family = type(self)
        kinds = fields.declared_nested_types(family)
        for field in dataclasses.fields(self) if kinds else ():
            value = getattr(self, field.name)
            if value is not field.default and not isinstance(value, kinds.get(field.name, object)):
                kind = fields.nested_types(family)[field.name].__name__
                raise ValueError(
                    f"{family.__name__}.{field.name} = {value!r}: must be a {kind}; to build one"
                    f" from nested mappings use {family.__name__}.from_mapping"
                )

    @staticmethod
    def advance(
        parameters: Parameters, timestep: float, state: FamilyTuple, inputs: Inputs
    ) -> tuple[FamilyTuple, float, FamilyTuple]:
        """Advance the actuator by one mechanical step.

        The function must be pure and written in plain Python that numba can compile unchanged.

        Args:
            parameters: named tuple of floats: all fields by name, including nested ones.
            timestep: mechanical step [s].
            state: `State` after the previous step.
            inputs: inputs that are held over the step.

        Returns:
            The new `State`, the torque delivered at the shaft [N*m] over the step, and `Signals`.
        """
        raise NotImplementedError

    @staticmethod
    def observe(
        parameters: Parameters, timestep: float, signals: FamilyTuple, inputs: Inputs
    ) -> tuple[float, ...]:
        """Return sensor readings of the signals, entries as in `OBSERVED`; compiled like `advance`.

        Args:
            parameters: as for `advance`.
            timestep: mechanical step [s].
            signals: signals of the last step; all 0 at the start of an episode.
            inputs: inputs at present; only time and key are set.
        """
        raise NotImplementedError

    @property
    def arm_radius(self) -> float:
        """Arm [m] between shaft and load: torque = arm*force; on a hinge it is 1/gear."""
        return 1.0

    @property
    def additions(self) -> JointAdditions:
        """Inertia and friction that the actuator adds to its joint."""
        return JointAdditions()

    @property
    def delivered_friction(self) -> JointAdditions:
        """Viscous and Coulomb friction at the joint that the delivered torque already contains."""
        return JointAdditions()

    @property
    def back_emf_damping(self) -> float:
        """Damping [N*m*s/rad] at the joint by the back-EMF: slope of the torque-speed line."""
        return 0.0

    @property
    def random(self) -> bool:
        """True if an episode needs a key for random numbers."""
        return any(value_at(self, path) != 0.0 for path in self.RANDOM)

    @property
    def winding(self) -> tuple[float, float] | None:
        """Resistance [ohm] and inductance [H] of the winding; None if there is none."""
        return None

    @property
    def voltage_limit(self) -> float | None:
        """Largest voltage [V], drawn in figures of the signal `voltage`; None if there is none."""
        return None

    @property
    def assumed(self) -> str:
        """Sentence that lists unspecified values and their defaults; empty if there are none."""
        return ""

    def commands(self) -> Mapping[str, Command]:
        """Return the commands available to an agent besides the force, by name.

        Raises:
            ValueError: a field makes a command impossible; the message names it.
        """
        return {}

    def check(self, timestep: float) -> None:
        """Raise if the actuator cannot be simulated at a mechanical step [s].

        Raises:
            UnstableError: the actuator is unstable; the message has the number and a remedy.
            ValueError: the actuator cannot be simulated at all; the message has the reason.
        """

    def check_shaft(self, timestep: float, inertia: float, held: bool = False) -> None:
        """Raise if the actuator cannot be simulated with this inertia; called if `closes_loops`.

        Args:
            timestep: mechanical step [s].
            inertia: total inertia at the shaft [kg*m^2], or mass [kg], including the rotor's, in
                the initial position of the model; this actuator's share if several drive the same
                joint.
            held: True if the inertia is not passed to `advance`, or if other things also change the
                speed.

        Raises:
            UnstableError: the actuator is unstable; the message has the number and a remedy.
        """

    @property
    def closes_loops(self) -> bool:
        """True if the torque may depend on position or speed, and stability on the load."""
        return self.INERTIA or self.MOTION or type(self) not in BUILT_IN

    def steps_per_sample(self, timestep: float) -> int:
        """Return the number of mechanical steps after which the pattern of samples repeats."""
        del timestep
        return 1

    def loop_remedy(self, inertia: float) -> str:
        """Return a remedy for the loop gains at an inertia [kg*m^2], for error messages."""
        return f"The inertia at its shaft is {inertia:.3g} kg*m^2: lower its gains."

    def check_at(self, timestep: float, allow_unstable: bool) -> None:
        """Run `check`, but ignore instability if `allow_unstable`.

        Raises:
            ValueError: see `check`.
        """
        try:
            self.check(timestep)
        except UnstableError:
            if not allow_unstable:
                raise

    @classmethod
    def instability(cls, parameter_values: np.ndarray, timestep: float) -> np.ndarray:
        """Return the instability of many actuators: >= 1 or NaN where `check` would raise.

        Args:
            parameter_values: shape (m, p), rows as in `ActuatorModel.parameter_values`.
            timestep: mechanical step [s].

        Returns:
            Shape (m,).
        """
        del timestep
        return np.zeros(len(parameter_values))

    @property
    def parameter_values(self) -> tuple[float, ...]:
        """Parameters in the order of `parameters_type`, as stored in a model's `user` data."""
        return tuple(
            float(value_at(self, path)) for path in parameter_paths(family_of(self)).values()
        )

    @classmethod
    def from_parameter_values(
        cls, parameter_values: Iterable[float], arm_radius: float = 1.0
    ) -> Self:
        """Return the actuator with these parameters.

        Args:
            parameter_values: shape (p,).
            arm_radius: arm [m], which is not a parameter of `advance`.

        Raises:
            ValueError: a value is out of its field's bounds.
        """
        values = dict(
            zip(parameter_paths(family_of(cls)).values(), map(float, parameter_values), strict=True)
        )
        values |= {path: arm_radius for path in field_paths(family_of(cls)) if is_arm(path)}
        return from_values(cls, values)

    def replaced(self, values: Mapping[str, FieldValue]) -> Self:
        """Return a copy with new values of some fields.

        Args:
            values: new values by dotted path, such as `motor.inductance`; if a nested part is None,
                its other fields take the values that None stands for.

        Raises:
            ValueError: a value is out of bounds.
        """
        whole = [field.name for field in dataclasses.fields(self)]
        fields.check_names(values, [*field_paths(family_of(self)), *whole], "actuator field")
        changes: dict[str, FieldValue] = {}
        nested: dict[str, dict[str, FieldValue]] = {}
        for path, value in values.items():
            name, _, rest = path.partition(".")
            if rest:
                nested.setdefault(name, {})[rest] = value
            else:
                changes[name] = to_field_type(type(self), name, value)
        for name, inner in nested.items():
            owner = value_at(self, name)
            kinds = {
                field: to_field_type(type(owner), field, value) for field, value in inner.items()
            }
            changes[name] = dataclasses.replace(owner, **kinds)
        return dataclasses.replace(self, **changes)

    @classmethod
    def from_mapping(cls, mapping: Mapping[str, object]) -> Self:
        """Build an actuator from nested mappings; missing fields take the dataclasses' defaults.

        Args:
            mapping: for example `{"motor": {"inductance": 0.2}, "controller": {"kp": 2.0}}`.

        Raises:
            ValueError: an unknown field (the message suggests the nearest name) or a value out of
                bounds.
        """
        return fields.build(cls, mapping, "actuator field")

    def as_mapping(self) -> dict[str, FieldValue]:
        """Return the nested mapping, including `family`, that `actuator_from_mapping` reads."""
        return {"family": family_name(family_of(self)), **dataclasses.asdict(self)}


Family = type[ActuatorModel]
"""A subclass of `ActuatorModel`."""
Advance = Callable[[Parameters, float, FamilyTuple, Inputs], tuple[FamilyTuple, float, FamilyTuple]]
"""`advance` of a family."""


def advance_signature(cls: Family) -> tuple[Form, str]:
    """Return the structure that `advance` must return, and where it is declared, for messages."""
    return (
        cls.State._fields,
        "torque",
        cls.Signals._fields,
    ), f"{cls.__name__}.State and {cls.__name__}.Signals"


@functools.cache
def check_family(cls: Family) -> None:
    """Raise if a family's functions, called with sample numbers, do not return what it declares."""
    for name in ("State", "Signals"):
        if not hasattr(kind := getattr(cls, name), "_fields"):
            raise ValueError(
                f"{cls.__name__}.{name} = {kind!r}: must be a typing.NamedTuple of floats"
            )
    if any(isinstance(value, dataclasses.Field) for value in vars(cls).values()):
        raise ValueError(
            f"{cls.__name__}: must be decorated with @dataclasses.dataclass(frozen=True)"
        )
    if reserved := {"desired_force", "actual_force", "speed"} & {*cls.Signals._fields}:
        raise ValueError(
            f"{cls.__name__}.Signals: {', '.join(reserved)}: every family has these signals: choose"
            " other names"
        )
    fields.check_names(cls.SIGNAL_UNITS, cls.Signals._fields, "signal", "SIGNAL_UNITS.")
    fields.check_names(cls.RANDOM, field_paths(cls), "field", "RANDOM: ")
    if missing := [
        field.name for field in dataclasses.fields(cls) if field.default is dataclasses.MISSING
    ]:
        raise ValueError(f"{cls.__name__}.{missing[0]}: must have a default")
    actuator = cls()
    for path in field_paths(cls):
        if not isinstance(value := value_at(actuator, path), int | float):
            raise ValueError(
                f"{cls.__name__}.{path} = {value!r}: must be a number; see `codrl_mj.fields`"
            )
    parameters, step = parameters_type(cls)(*actuator.parameter_values), np.float64(1e-3)
    inputs = Inputs(*map(np.float64, (0.1, 0.2, 0.3, 0.0, 0.0, 1.0)))
    state, signals = (
        kind._make(map(np.float64, [0.0] * len(kind._fields))) for kind in (cls.State, cls.Signals)
    )
    if cls.advance is ActuatorModel.advance:
        raise ValueError(f"{cls.__name__}: has no `advance`")
    result = call(f"{cls.__name__}.advance", cls.advance, parameters, step, state, inputs)
    after, torque, _ = check_form(cls.advance, result, *advance_signature(cls))
    if not np.isfinite([*after, torque]).all():
        raise ValueError(
            f"{source_location(cls.advance)}: returns the state {(*map(float, after),)} and the"
            f" torque {torque}: must be finite"
        )
    if cls.OBSERVED:
        readings = call(f"{cls.__name__}.observe", cls.observe, parameters, step, signals, inputs)
        check_form(cls.observe, readings, cls.OBSERVED, f"{cls.__name__}.OBSERVED")


def import_path(cls: type) -> str:
    """Return the import path of a family: `module:Class`."""
    return f"{cls.__module__}:{cls.__qualname__}"


@functools.cache
def family_id(cls: type) -> int:
    """Return the family's id in a model's `user` data: six digits of a hash of `import_path`."""
    # MuJoCo writes user data with six significant digits, so longer ids would not survive saving a
    # model as XML.
    return int(hashlib.sha256(import_path(cls).encode()).hexdigest(), 16) % 10**6


def family_name(cls: Family) -> str:
    """Return the name under which `find_family` finds a family."""
    name: str = cls.family
    return name if FAMILIES.get(name) is cls else import_path(cls)
