"""Masses, gravity and damping of somebody else's model, drawn anew for every episode."""

from collections.abc import Mapping

import mujoco
import numpy as np

from codrl_mj.envs.distributions import Distribution
from codrl_mj.fields import check_names
from codrl_mj.physics.variation import field_of

_FIELDS = {"mass": ("body_mass", "body_inertia"), "damping": ("dof_damping",), "gravity": ("opt.gravity",)}


class ModelFields:
    """The fields that numbers change, by the names that tasks of ours use.

    `model.mass.BODY` multiplies a body's mass and inertia, `model.gravity` gravity; `model.damping.JOINT` is the
    damping [N*s/m or N*m*s/rad] added to all degrees of freedom of a joint.
    """

    def __init__(self, data: mujoco.MjData, distributions: Mapping[str, Distribution]) -> None:
        """Find the fields.

        Args:
            data: a simulation of the model.
            distributions: what the numbers are drawn from, by their names.

        Raises:
            ValueError: an unknown name, or a distribution that reaches a number which is impossible there.
        """
        self._data, model = data, data.model
        bodies = {model.body(body).name: body for body in range(1, model.nbody) if model.body(body).name}
        joints = {model.joint(joint).name: joint for joint in range(model.njnt) if model.joint(joint).name}
        known = [*(f"model.mass.{name}" for name in bodies), *(f"model.damping.{name}" for name in joints)]
        check_names(distributions, [*known, "model.gravity"], "field", "randomize: ")
        self._entries: dict[str, list[tuple[str, slice]]] = {}
        for name, distribution in distributions.items():
            _, kind, owner = [*name.split(".", 2), ""][:3]
            low = min(distribution.extremes)
            if not np.isfinite(distribution.extremes).all() or low < 0.0 or (low == 0.0 and kind == "mass"):
                sign = ">" if kind == "mass" else ">="
                raise ValueError(f"randomize[{name!r}] = {distribution}: {low:g} must be a finite number {sign} 0")
            place = slice(None)
            if kind == "mass":
                place = slice(bodies[owner], bodies[owner] + 1)
            elif kind == "damping":
                place = slice(*_dofs(model, joints[owner]))
            self._entries[name] = [(field, place) for field in _FIELDS[kind]]
        used = {field for entries in self._entries.values() for field, _ in entries}
        self._nominal = {field: field_of(model, field).copy() for field in used}

    def put(self, values: Mapping[str, float]) -> None:
        """Give the model these numbers in place of its own; to be followed by a reset, or a restoring of the state."""
        model = self._data.model
        for field, nominal in self._nominal.items():
            field_of(model, field)[:] = nominal
        for name, value in values.items():
            for field, place in self._entries[name]:
                numbers = field_of(model, field)
                numbers[place] = numbers[place] + value if field == "dof_damping" else numbers[place] * value
        mujoco.mj_setConst(model, self._data)


def _dofs(model: mujoco.MjModel, joint: int) -> tuple[int, int]:
    """The first degree of freedom of a joint, and the one after its last."""
    start = int(model.jnt_dofadr[joint])
    return start, start + int((model.dof_jntid == joint).sum())
