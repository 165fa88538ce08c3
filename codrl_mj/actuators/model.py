"""What an actuator is to the rest of the package: a frozen dataclass of numbers, and one pure function.

A *family* of actuators is a subclass of `ActuatorModel`, in one file. What it says here is all that
is known of it elsewhere: the doors into MuJoCo, the analytic physics, configuration files, the
command line, randomisation, `info`, films and evaluations read it. docs/actuators.md builds one.
"""

import dataclasses
import functools
import hashlib
import math
from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np

from codrl_mj import fields
from codrl_mj.actuators.parameters import (
    as_kind,
    family_of,
    field_paths,
    from_values,
    is_arm,
    parameter_paths,
    parameters_type,
    value_at,
)
from codrl_mj.user_code import Form, call, check_form, place


class Inputs(NamedTuple):
    """What an actuator is told of the step that it drives; all of it is held over the step."""

    desired_torque: float
    """Torque asked for at the shaft [N*m], or force [N]."""
    position: float
    """Position of the shaft at the beginning of the step [rad] or [m]."""
    speed: float
    """Its speed there [rad/s] or [m/s]."""
    time: float
    """Time since the start of the episode [s], at the beginning of the step."""
    noise_key: float
    """Key of the episode's random numbers, a whole number: see `codrl_mj.actuators.noise`."""
    inertia: float = math.inf
    """Inertia at the shaft [kg*m^2], or mass [kg], of all that the model has it move, by the state
    at the beginning of the step; `inf` for families that do not ask for it, and where nobody knows.
    """


class UnstableError(ValueError):
    """An actuator that is not stable at a step; `allow_unstable=True` simulates it all the same."""


class Nothing(NamedTuple):
    """No states, or no signals."""


class Command(NamedTuple):
    """What an agent's action can stand for other than a force."""

    unit: str
    """Its unit, for messages."""
    actuator: "ActuatorModel"
    """What is simulated: the actuator with whatever the command goes past left out."""
    torque_per_unit: float
    """Torque [N*m] at the shaft that stands for a command of one."""
    limit: float | None
    """The largest command; None: that of the task's largest force."""
    fixed: Mapping[str, str]
    """Fields that cannot be drawn -> why."""


class JointAdditions(NamedTuple):
    """What an actuator adds to the joint that it drives."""

    armature: float = 0.0
    """Inertia [kg*m^2], or mass [kg]."""
    damping: float = 0.0
    """Viscous friction [N*m*s/rad], or [N*s/m]."""
    friction: float = 0.0
    """Coulomb friction [N*m], or [N]."""


Family = Any
"""A subclass of `ActuatorModel`: `type[ActuatorModel]`, which mypy takes for unhashable."""


FAMILIES: dict[str, Any] = {}
"""Our families by name, as they are defined; anybody else's is found as `module:Class`."""
BUILT_IN: list[Any] = []
"""They, and what their commands leave of them."""


@dataclasses.dataclass(frozen=True)
class ActuatorModel(fields.Checked):
    """Base of every family of actuators: a frozen dataclass whose fields are made with `codrl_mj.fields`.

    A family has a name, says its states and signals as `NamedTuple`s of floats, and defines
    `advance`. The other methods have defaults that suit an actuator without a gear, without
    electrics, and stable at any step.

    Raises:
        ValueError: a field is out of bounds.
    """

    family: ClassVar[str] = ""
    """The family's name in mappings, files and on the command line; `module:Class` will always do as well."""
    State: ClassVar[type] = Nothing
    """What it remembers: a `NamedTuple` of floats, all 0 at the start of an episode."""
    Signals: ClassVar[type] = Nothing
    """What can be seen of it after a step: a `NamedTuple` of floats. A signal called `saturated` is
    1 where the actuator is at its limit; `voltage_saturated`, `current_saturated` and
    `temperature_saturated` may say at which. Signals called `current` [A] and `voltage` [V] make
    the electrical measures of an evaluation.
    """
    SIGNAL_UNITS: ClassVar[Mapping[str, str]] = {}
    """Units of the signals, for tables and figures."""
    OBSERVED: ClassVar[tuple[str, ...]] = ()
    """Names of what `observe` returns: what `observe_actuator=True` appends to an observation."""
    RANDOM: ClassVar[tuple[str, ...]] = ()
    """Dotted paths of the fields that need the episode's key of random numbers where they are not 0."""
    is_torque_controlled: ClassVar[bool] = True
    """Whether a torque is asked for at all; otherwise what is delivered counts as desired."""
    INERTIA: ClassVar[bool] = False
    """Whether it is told the inertia at its shaft, which takes the engine some time to find."""
    MOTION: ClassVar[bool] = False
    """Whether what is asked of it is a position or a speed of the shaft, in [rad] or [rad/s], in place of a torque."""

    def __init_subclass__(cls, **named: Any) -> None:
        """Know a family of ours by its name, once; anybody else's is found as `module:Class`."""
        super().__init_subclass__(**named)
        if cls.__module__.startswith("codrl_mj.actuators.") and import_path(cls) not in map(
            import_path, BUILT_IN
        ):
            BUILT_IN.append(cls)
            if name := vars(cls).get("family"):
                FAMILIES[name] = cls

    def __post_init__(self) -> None:
        """Validate."""
        super().__post_init__()
        family: Any = type(self)
        kinds = fields.declared_parts(family)
        for field in dataclasses.fields(self) if kinds else ():
            given = getattr(self, field.name)
            if given is not field.default and not isinstance(given, kinds.get(field.name, object)):
                kind = fields.parts(family)[field.name].__name__
                raise ValueError(
                    f"{family.__name__}.{field.name} = {given!r}: must be a {kind}; to build one"
                    f" from nested mappings use {family.__name__}.from_mapping"
                )

    @staticmethod
    def advance(
        parameters: Any, timestep: float, state: Any, inputs: Inputs
    ) -> tuple[Any, float, Any]:
        """Advance by one mechanical step. A pure function, in plain Python that numba compiles as it stands.

        Args:
            parameters: a named tuple of floats: the fields by their names, those of parts too.
            timestep: mechanical step [s].
            state: a `State`, as the step before left it.
            inputs: what is held over the step.

        Returns:
            The new `State`, the torque delivered at the shaft [N*m] over the step, and `Signals`.
        """
        raise NotImplementedError

    @staticmethod
    def observe(
        parameters: Any, timestep: float, signals: Any, inputs: Inputs
    ) -> tuple[float, ...]:
        """What a sensor says of the signals at the time of `inputs`, entries as in `OBSERVED`; compiled as `advance`.

        Args:
            parameters: as for `advance`.
            timestep: mechanical step [s].
            signals: of the last step; all 0 at the start of an episode.
            inputs: of the present moment; only time and key are set.
        """
        raise NotImplementedError

    @property
    def arm_radius(self) -> float:
        """Arm [m] between shaft and load: torque = arm*force, speed of the shaft = speed/arm; 1/gear on a hinge."""
        return 1.0

    @property
    def additions(self) -> JointAdditions:
        """What it adds to its joint."""
        return JointAdditions()

    @property
    def back_emf_damping(self) -> float:
        """Damping [N*m*s/rad] at the joint that its back-EMF amounts to: the slope of its torque-speed line."""
        return 0.0

    @property
    def random(self) -> bool:
        """Whether an episode needs a key for its random numbers."""
        return any(value_at(self, path) != 0.0 for path in self.RANDOM)

    @property
    def winding(self) -> tuple[float, float] | None:
        """Resistance [ohm] and inductance [H] that its `current` flows through; None where there is none."""
        return None

    @property
    def voltage_limit(self) -> float | None:
        """The largest voltage [V], to be drawn in figures of the signal `voltage`."""
        return None

    @property
    def assumed(self) -> str:
        """A sentence on what is taken for numbers that nobody gave, for whoever uses it; empty where all are given."""
        return ""

    def commands(self) -> Mapping[str, Command]:
        """What an agent can command besides the force, by name.

        Raises:
            ValueError: when a command is read that the fields do not allow; the message names the
                field.
        """
        return {}

    def check(self, timestep: float) -> None:
        """Refuse what cannot be simulated at a mechanical step [s].

        Raises:
            UnstableError: it is unstable there; the reason, with its number, and a remedy.
            ValueError: it cannot be simulated at all, likewise.
        """

    def check_shaft(self, timestep: float, inertia: float, held: bool = False) -> None:
        """Refuse what cannot be simulated on a shaft that moves so much; called where `closes_loops`.

        Args:
            timestep: mechanical step [s].
            inertia: at the shaft [kg*m^2], or mass [kg], the rotor's own included, in the model's
                initial position; its share of it where several drive the same joint.
            held: whether it will not be told the inertia, or not be alone in changing the speed.

        Raises:
            UnstableError: it is unstable there; the reason, with its number, and a remedy.
        """

    @property
    def closes_loops(self) -> bool:
        """True if it may close a loop over its shaft's position or speed, to be checked with what it moves."""
        return self.INERTIA or self.MOTION or type(self) not in BUILT_IN

    def steps_per_sample(self, timestep: float) -> int:
        """Return the number of mechanical steps [s] after which its samples repeat."""
        del timestep
        return 1

    def loop_remedy(self, inertia: float) -> str:
        """Return a sentence on the gains of its loop over a shaft that moves an inertia [kg*m^2], for messages."""
        return f"It moves {inertia:.3g} kg*m^2 at its shaft: lower its gains."

    def check_at(self, timestep: float, allow_unstable: bool) -> None:
        """`check`, but what is only unstable may be allowed.

        Raises:
            ValueError: see `check`.
        """
        try:
            self.check(timestep)
        except UnstableError:
            if not allow_unstable:
                raise

    @classmethod
    def instability(cls, numbers: np.ndarray, timestep: float) -> np.ndarray:
        """How unstable actuators are at a mechanical step: 1 or more, or NaN, where `check` would refuse.

        Args:
            numbers: shape (m, p), rows as `numbers` returns them.
            timestep: mechanical step [s].

        Returns:
            Shape (m,).
        """
        del timestep
        return np.zeros(len(numbers))

    @property
    def parameter_values(self) -> tuple[float, ...]:
        """The parameters, in the order of `parameters_type`: what a model's `user` data hold."""
        return tuple(
            float(value_at(self, path)) for path in parameter_paths(family_of(self)).values()
        )

    @classmethod
    def from_parameter_values(cls, numbers: Any, arm_radius: float = 1.0) -> Any:
        """The actuator that `numbers` describe.

        Args:
            numbers: shape (p,).
            arm_radius: the arm [m], which is not among them.

        Raises:
            ValueError: a number is out of its field's bounds.
        """
        values = dict(
            zip(parameter_paths(family_of(cls)).values(), map(float, numbers), strict=True)
        )
        values |= {path: arm_radius for path in field_paths(family_of(cls)) if is_arm(path)}
        return from_values(cls, values)

    def replaced(self, values: Mapping[str, Any]) -> Self:
        """A copy with other values of some fields.

        Args:
            values: by dotted path, such as `motor.inductance`; in a part that is None, over what
                stands for it.

        Raises:
            ValueError: a value is out of bounds.
        """
        whole = [field.name for field in dataclasses.fields(self)]
        fields.check_names(values, [*field_paths(family_of(self)), *whole], "actuator field")
        changes: dict[str, Any] = {}
        nested: dict[str, dict[str, Any]] = {}
        for path, value in values.items():
            name, _, rest = path.partition(".")
            if rest:
                nested.setdefault(name, {})[rest] = value
            else:
                changes[name] = as_kind(type(self), name, value)
        for name, inner in nested.items():
            owner = value_at(self, name)
            kinds = {field: as_kind(type(owner), field, value) for field, value in inner.items()}
            changes[name] = dataclasses.replace(owner, **kinds)
        return dataclasses.replace(self, **changes)

    @classmethod
    def from_mapping(cls, mapping: Mapping[str, Any]) -> Any:
        """Build one from nested mappings; absent fields take the dataclasses' defaults.

        Args:
            mapping: for example `{"motor": {"inductance": 0.2}, "controller": {"kp": 2.0}}`.

        Raises:
            ValueError: an unknown field (the nearest known one is suggested) or a value out of
                bounds.
        """
        return fields.build(cls, mapping, "actuator field")

    def as_mapping(self) -> dict[str, Any]:
        """The nested mapping, `family` included, that `actuator_from_mapping` reads."""
        return {"family": family_name(family_of(self)), **dataclasses.asdict(self)}


def advance_signature(cls: Family) -> tuple[Form, str]:
    """What `advance` is to return, and what says so."""
    return (
        cls.State._fields,
        "torque",
        cls.Signals._fields,
    ), f"{cls.__name__}.State and {cls.__name__}.Signals"


@functools.cache
def check_family(cls: Family) -> None:
    """Refuse a family whose functions do not return what it declares: each is called once on plain numbers."""
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
            f"{cls.__name__}.Signals: {', '.join(reserved)}: every family has that: choose another"
            " name"
        )
    fields.check_names(cls.SIGNAL_UNITS, cls.Signals._fields, "signal", "SIGNAL_UNITS.")
    fields.check_names(cls.RANDOM, field_paths(cls), "field", "RANDOM: ")
    if missing := [
        one.name for one in dataclasses.fields(cls) if one.default is dataclasses.MISSING
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
        kind(*map(np.float64, [0.0] * len(kind._fields))) for kind in (cls.State, cls.Signals)
    )
    if cls.advance is ActuatorModel.advance:
        raise ValueError(f"{cls.__name__}: has no `advance`")
    result = call(f"{cls.__name__}.advance", cls.advance, parameters, step, state, inputs)
    after, torque, _ = check_form(cls.advance, result, *advance_signature(cls))
    if not np.isfinite([*after, torque]).all():
        raise ValueError(
            f"{place(cls.advance)}: returns the state {(*map(float, after),)} and the torque"
            f" {torque}: must be finite"
        )
    if cls.OBSERVED:
        seen = call(f"{cls.__name__}.observe", cls.observe, parameters, step, signals, inputs)
        check_form(cls.observe, seen, cls.OBSERVED, f"{cls.__name__}.OBSERVED")


def import_path(cls: type) -> str:
    """Where a family is to be imported from: `module:Class`."""
    return f"{cls.__module__}:{cls.__qualname__}"


@functools.cache
def family_id(cls: type) -> int:
    """The family's number in a model's `user` data: six digits of a hash of `reference`, which survive as text."""
    return int(hashlib.sha256(import_path(cls).encode()).hexdigest(), 16) % 10**6


def family_name(cls: Family) -> str:
    """The name that `find_family` finds it by."""
    name: str = cls.family
    return name if FAMILIES.get(name) is cls else import_path(cls)
