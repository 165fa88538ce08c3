"""Variations of a model, of many simulations at once: masses, lengths, gravity, damping, and what motors add to it."""

import copy
import functools
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import mujoco
import numpy as np

from codrl_mj.actuators import IDEAL, ActuatorModel
from codrl_mj.disturbances import UNMODIFIED_JOINT, Joint
from codrl_mj.engine.hill import GRAVITY
from codrl_mj.physics.base import SimulationConfig
from codrl_mj.physics.mjcf import hills, task_model
from codrl_mj.tasks import TASKS

VISUAL_FIELDS = ("geom_pos", "geom_size")
"""Fields that only pictures depend on."""
_FIELDS = {
    "mass": ("body_mass", "body_inertia"),
    "length": ("body_ipos", "body_inertia", "body_pos", *VISUAL_FIELDS),
    "damping": ("dof_damping",),
    "gravity": ("opt.gravity", "jnt_user"),
}
DYNAMIC_FIELDS = tuple(
    dict.fromkeys(name for names in _FIELDS.values() for name in names if name not in VISUAL_FIELDS)
)
"""Fields that the dynamics depend on."""


class JointAddress(NamedTuple):
    """Where a motor's share of one entry of its `JointAdditions` is in a model."""

    field: str
    """Of the model."""
    place: int
    """In it."""
    scale: float
    """The model's number is that many times the motor's."""


def joint_addresses(model: mujoco.MjModel, index: int) -> tuple[JointAddress | None, ...]:
    """Where an actuator's additions go, entries as in `JointAdditions`; None where the model has no place for them.

    Those of a motor in the control callback are its joint's; a plugin keeps gear, inertia and
    damping to itself.
    """
    kind, driven = mujoco.mjtTrn(model.actuator_trntype[index]), int(model.actuator_trnid[index, 0])
    rubs: JointAddress | None = None
    scale = abs(float(model.actuator_gear[model.actuator_outadr[index], 0]))
    if kind in (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT):
        dof = int(model.jnt_dofadr[driven])
        if model.actuator_plugin[index] < 0:
            return tuple(
                JointAddress(f"dof_{name}", dof, 1.0)
                for name in ("armature", "damping", "frictionloss")
            )
        rubs = JointAddress("dof_frictionloss", dof, scale)
    elif kind == mujoco.mjtTrn.mjTRN_TENDON:
        rubs = JointAddress("tendon_frictionloss", driven, scale)
    return (
        JointAddress("actuator_armature", index, 1.0),
        JointAddress("actuator_damping", index, 1.0),
        rubs,
    )


@functools.cache
def bare_model(task: str, joint: Joint = UNMODIFIED_JOINT) -> mujoco.MjModel:
    """The model of the task of a name, with nothing on its actuated joints but what is given; read only."""
    return task_model(
        SimulationConfig(TASKS[task], (IDEAL,) * len(TASKS[task].motors), joint=joint)
    )


def without_motors(model: mujoco.MjModel, motors: Mapping[int, ActuatorModel]) -> mujoco.MjModel:
    """A copy of a model without what its motors, by the indices of their actuators, add to it."""
    bare = copy.copy(model)
    for index, motor in motors.items():
        for mount, added in zip(joint_addresses(model, index), motor.additions, strict=True):
            if mount is not None:
                getattr(bare, mount.field)[mount.place] -= added * mount.scale
    return bare


def arms_and_additions(motors: Sequence[Sequence[ActuatorModel]]) -> tuple[np.ndarray, np.ndarray]:
    """The arms [m] of the motors of m simulations, (m, n), and their `JointAdditions`, (m, n, 3)."""
    arms = np.array([[one.arm_radius for one in each] for each in motors])
    return arms, np.array([[one.additions for one in each] for each in motors])


def variable_names(model: mujoco.MjModel) -> tuple[str, ...]:
    """Names of what can be varied of a model."""
    bodies = {
        body: model.body(body).name for body in range(1, model.nbody) if model.body(body).name
    }
    joints = [model.joint(joint).name for joint in range(model.njnt)]
    names = [f"model.mass.{name}" for name in bodies.values()]
    names += [f"model.length.{name}" for body, name in bodies.items() if _has_length(model, body)]
    names += [f"model.damping.{name}" for name in joints if name]
    return (*names, "model.gravity")


def _has_length(model: mujoco.MjModel, body: int) -> bool:
    """Whether a body turns about its joint, has its centre of mass on the z axis from there, and touches nothing."""
    joints = range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body])
    turns = all(
        model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE and not model.jnt_pos[joint].any()
        for joint in joints
    )
    flags = mujoco.mjtDisableBit.mjDSBL_CONSTRAINT | mujoco.mjtDisableBit.mjDSBL_CONTACT
    touches = (
        model.geom_contype | model.geom_conaffinity
    ).any() and not model.opt.disableflags & flags
    held = touches or model.ntendon or model.neq
    x, y, z = model.body_ipos[body]
    return (
        turns
        and bool(z)
        and x == y == 0.0
        and list(model.body_iquat[body]) == [1.0, 0.0, 0.0, 0.0]
        and not held
    )


class Variation:
    """How numbers change the fields of a compiled model.

    `model.mass.BODY` multiplies a body's mass and inertia, `model.length.BODY` all distances along
    it (its centre of mass, what hangs on it, what is drawn of it) and, squared, its inertia about
    the axes across it, `model.gravity` gravity and the force of a hill; `model.damping.JOINT` is
    the damping [N*s/m or N*m*s/rad] added to a joint.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        names: Sequence[str] = (),
        motors: Sequence[int] = (),
        mounting: bool = False,
    ) -> None:
        """Find the fields of what is varied, names of `variable(model)`.

        `motors` are the indices of actuators whose additions are not in the model; `mounting`
        varies these, too.
        """
        self.names = tuple(names)
        self._mounts = [joint_addresses(model, index) for index in motors]
        fields = [field for name in names for field in _FIELDS[name.split(".")[1]]]
        fields += [
            mount.field for mounts in self._mounts for mount in mounts if mount is not None
        ] * mounting
        self._nominal = {field: field_of(model, field).copy() for field in fields}
        self._neutral = np.array([float(not name.startswith("model.damping.")) for name in names])
        self._bodies = {model.body(body).name: body for body in range(model.nbody)}
        self._dofs = {
            model.joint(joint).name: model.dof_jntid == joint for joint in range(model.njnt)
        }
        self._parents = model.body_parentid.copy()
        self._geom_bodies = model.geom_bodyid.copy()
        self._geoms_along = _along(model)
        self._hills = hills(model)

    def fields(
        self, values: np.ndarray, additions: np.ndarray | None = None, shown: bool = False
    ) -> dict[str, np.ndarray]:
        """The varied fields of the model, by name (`opt.` before an option's), shape (m, ...).

        `values`, shape (m, k), has a column for each of `names`, NaN where it is as it was;
        `additions` are as `arms_and_additions` has them; `shown` includes the fields that only pictures
        depend on.
        """
        fields = {
            field: np.repeat(nominal[np.newaxis], len(values), axis=0)
            for field, nominal in self._nominal.items()
            if shown or field not in VISUAL_FIELDS
        }
        for name, column in zip(
            self.names, np.where(np.isnan(values), self._neutral, values).T, strict=True
        ):
            kind, _, target = name.removeprefix("model.").partition(".")
            body, each = self._bodies.get(target), column[:, np.newaxis]
            if kind == "mass":
                fields["body_mass"][:, body] *= column
                fields["body_inertia"][:, body] *= each
            elif kind == "length":
                fields["body_ipos"][:, body] *= each
                fields["body_inertia"][:, body, :2] *= each**2
                fields["body_pos"][:, self._parents == body] *= each[:, np.newaxis]
                for geom in (
                    np.flatnonzero(self._geom_bodies == body).tolist()
                    if "geom_pos" in fields
                    else ()
                ):
                    fields["geom_pos"][:, geom, 2] *= column
                    if geom in self._geoms_along:
                        fields["geom_size"][:, geom, self._geoms_along[geom]] *= column
            elif kind == "damping":
                fields["dof_damping"][:, self._dofs[target]] += each
            else:
                fields["opt.gravity"] *= each
                for joint in self._hills:
                    fields["jnt_user"][:, joint, GRAVITY] *= column
        for motor, mounts in enumerate(self._mounts if additions is not None else ()):
            for entry, mount in enumerate(mounts):
                if mount is not None and mount.field in fields:
                    fields[mount.field][:, mount.place] += additions[:, motor, entry] * mount.scale  # type: ignore[index]
        return fields


def _along(model: mujoco.MjModel) -> dict[int, int]:
    """Geoms with a length along their body's z axis, each with the entry of its size that is half that length."""
    kinds = mujoco.mjtGeom
    entries = {
        int(kinds.mjGEOM_CAPSULE): 1,
        int(kinds.mjGEOM_CYLINDER): 1,
        int(kinds.mjGEOM_BOX): 2,
    }
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
        setattr(
            model.opt if name.startswith("opt.") else model, name.removeprefix("opt."), values[row]
        )
