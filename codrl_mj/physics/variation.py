"""Variations of a task's model, of many simulations at once: masses, lengths, gravity, damping, rotors on joints."""

import functools
from collections.abc import Mapping, Sequence

import mujoco
import numpy as np

from codrl_mj.actuators import IDEAL, ActuatorModel
from codrl_mj.disturbances import PLAIN, Joint
from codrl_mj.engine.hill import GRAVITY
from codrl_mj.fields import did_you_mean
from codrl_mj.physics.mjcf import hills, task_model
from codrl_mj.tasks import TASKS

DRAWN = ("geom_pos", "geom_size")
"""Fields that only what is drawn depends on."""
ADDED = ("dof_armature", "dof_damping", "dof_frictionloss")
"""What an actuator adds to the degree of freedom of its joint: entries as in `JointAdditions`."""


@functools.cache
def _nominal_model(task: str, joint: Joint = PLAIN) -> mujoco.MjModel:
    """A task's model with ideal actuators, read only."""
    return task_model(TASKS[task], (IDEAL,) * len(TASKS[task].motors), TASKS[task].step_duration, joint=joint)


def additions_of(actuators: Sequence[Sequence[ActuatorModel]]) -> np.ndarray:
    """What the actuators of m environments add to their joints, shape (m, n, 3), entries as in `JointAdditions`."""
    return np.array([[one.additions for one in each] for each in actuators])


def variable(task: str) -> tuple[str, ...]:
    """Names of what can be varied of the model of the task of a name."""
    model = _nominal_model(task)
    names = [f"model.mass.{model.body(body).name}" for body in range(1, model.nbody)]
    names += [f"model.length.{model.body(body).name}" for body in range(1, model.nbody) if _has_length(model, body)]
    names += [f"model.damping.{model.joint(joint).name}" for joint in range(model.njnt)]
    return (*names, "model.gravity")


def _has_length(model: mujoco.MjModel, body: int) -> bool:
    """Whether a body turns about its joint and has its centre of mass on the z axis from there."""
    joints = range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body])
    turns = all(
        model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE and not model.jnt_pos[joint].any() for joint in joints
    )
    x, y, z = model.body_ipos[body]
    return turns and bool(z) and x == y == 0.0 and list(model.body_iquat[body]) == [1.0, 0.0, 0.0, 0.0]


class Variation:
    """How numbers change the fields of a task's compiled model.

    `model.mass.BODY` multiplies a body's mass and inertia, `model.length.BODY` all distances along it (its centre of
    mass, what hangs on it, what is drawn of it) and, squared, its inertia about the axes across it, `model.gravity`
    gravity and the force of a hill; `model.damping.JOINT` is the damping [N*s/m or N*m*s/rad] added to a joint.
    """

    def __init__(
        self,
        task: str,
        names: Sequence[str],
        model: mujoco.MjModel | None = None,
        joint: Joint = PLAIN,
        mounting: bool = False,
    ) -> None:
        """Find the fields of what is varied, of `variable(task)`, in a model of the task: its own, or one given.

        That has `joint` on its actuated joints; `mounting` varies what actuators add to their joints, too.

        Raises:
            ValueError: an unknown name; the nearest known one is suggested.
        """
        model = _nominal_model(task, joint) if model is None else model
        known = variable(task)
        self.names = tuple(names)
        self._nominal: dict[str, np.ndarray] = {}
        for name in names:
            if name not in known:
                raise ValueError(f"unknown {name!r}: {did_you_mean(name, known)}{task} has {', '.join(known)}")
            for field in _FIELDS[name.split(".")[1]]:
                self._nominal[field] = field_of(model, field).copy()
        self._nominal |= {field: field_of(model, field).copy() for field in ADDED if mounting}
        self._bodies = {model.body(body).name: body for body in range(model.nbody)}
        self._dofs = {model.joint(joint).name: int(model.jnt_dofadr[joint]) for joint in range(model.njnt)}
        self._parents = model.body_parentid.copy()
        self._geom_bodies = model.geom_bodyid.copy()
        self._geoms_along = _along(model)
        self._hills = hills(model)
        self._driven = [model.jnt_dofadr[model.actuator(name).trnid[0]] for name in TASKS[task].motors]

    def fields(
        self, values: np.ndarray, additions: np.ndarray | None = None, drawn: bool = False
    ) -> dict[str, np.ndarray]:
        """The varied fields of the model, by name (`opt.` before an option's), shape (m, ...).

        `values`, shape (m, k), has a column for each of `names`; `additions` are as `additions_of` has them; `drawn`
        includes the fields that only what is drawn depends on.
        """
        fields = {
            field: np.repeat(nominal[np.newaxis], len(values), axis=0)
            for field, nominal in self._nominal.items()
            if drawn or field not in DRAWN
        }
        for name, column in zip(self.names, values.T, strict=True):
            kind, _, target = name.removeprefix("model.").partition(".")
            if kind == "mass":
                body = self._bodies[target]
                fields["body_mass"][:, body] *= column
                fields["body_inertia"][:, body] *= column[:, np.newaxis]
            elif kind == "length":
                self._stretch(fields, self._bodies[target], column)
            elif kind == "damping":
                fields["dof_damping"][:, self._dofs[target]] += column
            else:
                fields["opt.gravity"] *= column[:, np.newaxis]
                for joint in self._hills:
                    fields["jnt_user"][:, joint, GRAVITY] *= column
        for entry, field in enumerate(ADDED):
            if field in fields and additions is not None:
                for motor, dof in enumerate(self._driven):
                    fields[field][:, dof] += additions[:, motor, entry]
        return fields

    def _stretch(self, fields: dict[str, np.ndarray], body: int, factor: np.ndarray) -> None:
        """Multiply the lengths along a body."""
        fields["body_ipos"][:, body] *= factor[:, np.newaxis]
        fields["body_inertia"][:, body, :2] *= factor[:, np.newaxis] ** 2
        for child in np.flatnonzero(self._parents == body).tolist():
            fields["body_pos"][:, child] *= factor[:, np.newaxis]
        if "geom_pos" in fields:
            for geom in np.flatnonzero(self._geom_bodies == body).tolist():
                fields["geom_pos"][:, geom, 2] *= factor
                if geom in self._geoms_along:
                    fields["geom_size"][:, geom, self._geoms_along[geom]] *= factor


_FIELDS = {
    "mass": ("body_mass", "body_inertia"),
    "length": ("body_ipos", "body_inertia", "body_pos", *DRAWN),
    "damping": ("dof_damping",),
    "gravity": ("opt.gravity", "jnt_user"),
}
VARIED = tuple(dict.fromkeys(name for names in _FIELDS.values() for name in names if name not in DRAWN))
"""Fields that the dynamics depend on."""


def _along(model: mujoco.MjModel) -> dict[int, int]:
    """Geoms with a length along their body's z axis, each with the entry of its size that is half that length."""
    kinds = mujoco.mjtGeom
    entries = {int(kinds.mjGEOM_CAPSULE): 1, int(kinds.mjGEOM_CYLINDER): 1, int(kinds.mjGEOM_BOX): 2}
    found = {}
    for geom in range(model.ngeom):
        matrix = np.empty(9)
        mujoco.mju_quat2Mat(matrix, model.geom_quat[geom])
        kind = int(model.geom_type[geom])
        if kind in entries and abs(matrix[8]) > 1.0 - 1e-9:
            found[geom] = entries[kind]
    return found


def field_of(model: mujoco.MjModel, name: str) -> np.ndarray:
    """A field of a model, live, by its name as `Variation.fields` has it."""
    return getattr(model.opt if name.startswith("opt.") else model, name.removeprefix("opt."))


def write_fields(model: mujoco.MjModel, fields: Mapping[str, np.ndarray], row: int = 0) -> None:
    """Write one row of varied fields into a model; what the engine derives from them is not changed."""
    for name, values in fields.items():
        setattr(model.opt if name.startswith("opt.") else model, name.removeprefix("opt."), values[row])
