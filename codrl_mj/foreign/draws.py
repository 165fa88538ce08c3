"""Motors of somebody else's model, and the model itself, drawn anew for every episode."""

from collections.abc import Callable, Mapping
from typing import Any

import mujoco
import numpy as np

from codrl_mj.actuators import ActuatorModel, Family, JointAdditions, field_paths
from codrl_mj.engine.plugin import PLUGIN_HEAD
from codrl_mj.envs.distributions import Distribution, parse
from codrl_mj.envs.randomization import LIMIT
from codrl_mj.fields import check_names
from codrl_mj.foreign.model_fields import ModelFields
from codrl_mj.specs import ON_JOINT

PREFIX = "model."
"""Of the fields that are the model's."""


class Draws:
    """Distributions of the fields of motors, by their patterns, and of the model's.

    The motors of one pattern get the same values.
    """

    def __init__(
        self,
        randomize: Mapping[str, Any],
        nominal: Mapping[str, ActuatorModel],
        fixed: Mapping[str, Mapping[str, str]],
        data: mujoco.MjData,
    ) -> None:
        """Check the distributions against the fields that they are for.

        Args:
            randomize: pattern -> field -> distribution, or its text; and field of the model -> distribution.
            nominal: pattern -> what is simulated.
            fixed: pattern -> field that cannot be drawn -> why.
            data: a simulation of the model.

        Raises:
            ValueError: a pattern or a field is unknown, or a distribution is none or beyond the field's bounds.
        """
        own = dict(randomize) if isinstance(randomize, Mapping) else {}
        of_model = {name: own.pop(name) for name in list(own) if str(name).startswith(PREFIX)}
        if not isinstance(randomize, Mapping) or not all(isinstance(each, Mapping) for each in own.values()):
            raise ValueError(
                f"randomize = {randomize!r}: must be a mapping of the actuators' patterns to mappings of fields to "
                f"distributions, such as {{{next(iter(nominal))!r}: {{'motor.resistance': 'uniform(0.4, 0.6)'}}}}"
            )
        check_names(own, nominal, "pattern", "randomize: ")
        self._nominal = {pattern: nominal[pattern] for pattern in own}
        self._distributions: dict[str, dict[str, Distribution]] = {}
        for pattern, given in own.items():
            actuator, family = nominal[pattern], _family(nominal[pattern])
            check_names(given, field_paths(family), "field", f"randomize[{pattern!r}]: ")
            self._distributions[pattern] = {}
            for name, text in given.items():
                try:
                    distribution = text if isinstance(text, Distribution) else parse(text)
                    if name in fixed.get(pattern, {}):
                        raise ValueError(fixed[pattern][name])
                    for value in distribution.extremes:
                        actuator.replaced({name: value})  # the field's own bounds
                except ValueError as error:
                    raise ValueError(f"randomize[{pattern!r}][{name!r}] = {text}: {error}") from None
                self._distributions[pattern][name] = distribution
        self._of_model: dict[str, Distribution] = {}
        for name, text in of_model.items():
            try:
                self._of_model[name] = text if isinstance(text, Distribution) else parse(text)
            except ValueError as error:
                raise ValueError(f"randomize[{name!r}] = {text}: {error}") from None
        self._fields = ModelFields(data, self._of_model) if of_model else None

    @property
    def size(self) -> int:
        """How many numbers `draw` returns."""
        return sum(map(len, self._distributions.values())) + len(self._of_model) + 1

    def draw(self, generator: np.random.Generator, put: Callable[[np.ndarray], None]) -> np.ndarray:
        """Draw until what is drawn can be simulated.

        Args:
            generator: draws.
            put: puts values into the model; raises a ValueError where its motors are not stable then.

        Returns:
            The values, and how many sets were rejected before: shape (k + 1,).

        Raises:
            ValueError: `LIMIT` sets in a row were rejected.
        """
        each = [one for own in self._distributions.values() for one in own.values()] + [*self._of_model.values()]
        reason = ""
        for rejected in range(LIMIT):
            values = np.array([*(one.transform(generator.random(1))[0] for one in each), rejected])
            try:
                put(values)
            except ValueError as error:
                reason = str(error)
            else:
                return values
        raise ValueError(
            f"randomize: {LIMIT} draws in a row were refused; the last was {self.report(values)}: {reason}. Narrow the "
            "bounds, or pass allow_unstable=True"
        )

    def actuators(self, values: np.ndarray) -> dict[str, ActuatorModel]:
        """Pattern -> the actuator of a draw."""
        return {pattern: one.replaced(self.report(values)[pattern]) for pattern, one in self._nominal.items()}

    def put_fields(self, values: np.ndarray | None) -> None:
        """Give the model the fields of a draw, or its own; to be followed by a reset, or a restoring of the state."""
        if self._fields is not None:
            drawn = {} if values is None else self.report(values)
            self._fields.put({name: drawn[name] for name in self._of_model if name in drawn})

    def report(self, values: np.ndarray) -> dict[str, Any]:
        """What `info` says of a draw: pattern -> field -> value, and `rejected`."""
        left = iter(values.tolist())
        named: dict[str, Any] = {
            pattern: {name: next(left) for name in own} for pattern, own in self._distributions.items()
        }
        named |= {name: next(left) for name in self._of_model}
        return named | {"rejected": int(next(left))}


class Exchange:
    """Puts other actuators of their families in the place of the motors of a compiled model."""

    def __init__(
        self, data: mujoco.MjData, motors: Mapping[int, ActuatorModel], places: Mapping[str, list[int]]
    ) -> None:
        """Remember what the model has.

        Args:
            data: a simulation of the model.
            motors: as `codrl_mj.motors` reads them.
            places: pattern -> indices of its motors.
        """
        self._model, self._data, self._nominal, self._places = data.model, data, dict(motors), places
        self._fields = {
            name: getattr(data.model, name).copy()
            for name in ("actuator_armature", "actuator_damping", "dof_frictionloss", "tendon_frictionloss")
        }
        self._added = False

    def put(self, actuators: Mapping[str, ActuatorModel]) -> None:
        """Let motors be others; to be followed by a reset, or a restoring of the state.

        Args:
            actuators: pattern -> actuator, of the family that is there.

        Raises:
            ValueError: friction is to be put where there is neither joint nor tendon.
        """
        model, added = self._model, self._added
        self._added = False
        for name, values in self._fields.items() if added else ():
            getattr(model, name)[:] = values
        for pattern, actuator in actuators.items():
            numbers, new = (actuator.arm_radius, *actuator.numbers), actuator.additions
            for index in self._places[pattern]:
                model.actuator_user[index, PLUGIN_HEAD - 1 : PLUGIN_HEAD - 1 + len(numbers)] = numbers
                self._add(index, self._nominal[index].additions, new)
        if added or self._added:
            mujoco.mj_setConst(model, self._data)

    def _add(self, index: int, old: JointAdditions, new: JointAdditions) -> None:
        """Let a motor add other things to its joint."""
        if new == old:
            return
        model, self._added = self._model, True
        model.actuator_armature[index] += new.armature - old.armature
        model.actuator_damping[index] += new.damping - old.damping
        if new.friction != old.friction:
            losses, place = self._friction(index)
            losses[place] += (new.friction - old.friction) * abs(model.actuator_gear[model.actuator_outadr[index], 0])

    def _friction(self, index: int) -> tuple[np.ndarray, int]:
        """Where the friction of what an actuator drives is."""
        model, kind = self._model, mujoco.mjtTrn(self._model.actuator_trntype[index])
        driven = int(model.actuator_trnid[index, 0])
        if kind in ON_JOINT:
            return model.dof_frictionloss, int(model.jnt_dofadr[driven])
        if kind == mujoco.mjtTrn.mjTRN_TENDON:
            return model.tendon_frictionloss, driven
        raise ValueError(
            f"{model.actuator(index).name or f'actuator {index}'}: it drives neither a joint nor a tendon, which the "
            "friction that is drawn for its motor would need; draw other fields"
        )


def _family(actuator: ActuatorModel) -> Family:
    return type(actuator)
