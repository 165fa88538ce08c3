"""Variations of model fields for many simulations: masses, lengths, gravity, damping, motors."""

import copy
import functools
from collections.abc import Mapping, Sequence

import mujoco
import numpy as np

from codrl_mj.actuators import IDEAL, ActuatorModel
from codrl_mj.disturbances import UNMODIFIED_JOINT, Joint
from codrl_mj.engine.hill import GRAVITY
from codrl_mj.engine.mounting import joint_addresses
from codrl_mj.physics.base import SimulationConfig
from codrl_mj.physics.mjcf import hills, task_model
from codrl_mj.tasks import TASKS
from codrl_mj.tasks.base import Options

VISUAL_FIELDS = ("geom_pos", "geom_size")
"""Fields that affect only rendering."""
_FIELDS = {
    "mass": ("body_mass", "body_inertia"),
    "length": ("body_ipos", "body_inertia", "body_pos", *VISUAL_FIELDS),
    "damping": ("dof_damping",),
    "gravity": ("opt.gravity", "jnt_user"),
}
DYNAMIC_FIELDS = tuple(
    dict.fromkeys(name for names in _FIELDS.values() for name in names if name not in VISUAL_FIELDS)
)
"""Fields that affect the dynamics."""


@functools.cache
def bare_model(
    task: str, joint: Joint = UNMODIFIED_JOINT, options: Options = None
) -> mujoco.MjModel:
    """Return the cached model of a task without its actuators' additions; do not change it.

    Args:
        task: name of the task.
        joint: quantities added to its actuated joints.
        options: options of the task; None for their defaults.
    """
    actuators = (IDEAL,) * len(TASKS[task].motors)
    return task_model(SimulationConfig(TASKS[task], actuators, joint=joint, options=options))


def without_additions(model: mujoco.MjModel, motors: Mapping[int, ActuatorModel]) -> mujoco.MjModel:
    """Return a copy of a model without the additions of its motors, keyed by actuator index."""
    bare = copy.copy(model)
    for index, motor in motors.items():
        for address, addition in zip(joint_addresses(model, index), motor.additions, strict=True):
            if address is not None:
                getattr(bare, address.field)[address.field_index] -= addition * address.scale
    return bare


def arms_and_additions(motors: Sequence[Sequence[ActuatorModel]]) -> tuple[np.ndarray, np.ndarray]:
    """Return arms [m], (m, n), and additions, (m, n, 3), of the motors of m simulations."""
    arms = np.array([[motor.arm_radius for motor in row] for row in motors])
    return arms, np.array([[motor.additions for motor in row] for row in motors])


def variable_names(model: mujoco.MjModel) -> tuple[str, ...]:
    """Return the names of all quantities of a model that can be varied."""
    bodies = {
        body: model.body(body).name for body in range(1, model.nbody) if model.body(body).name
    }
    joints = [model.joint(joint).name for joint in range(model.njnt)]
    names = [f"model.mass.{name}" for name in bodies.values()]
    names += [f"model.length.{name}" for body, name in bodies.items() if _has_length(model, body)]
    names += [f"model.damping.{name}" for name in joints if name]
    return (*names, "model.gravity")


def _has_length(model: mujoco.MjModel, body: int) -> bool:
    """Return True if `model.length.BODY` can scale a body.

    Its joints must be hinges at its origin, its center of mass must be on its z axis, and the model
    must have no contacts or other constraints.
    """
    joints = range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body])
    has_only_hinges = all(
        model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE and not model.jnt_pos[joint].any()
        for joint in joints
    )
    flags = mujoco.mjtDisableBit.mjDSBL_CONSTRAINT | mujoco.mjtDisableBit.mjDSBL_CONTACT
    has_contacts = (
        model.geom_contype | model.geom_conaffinity
    ).any() and not model.opt.disableflags & flags
    is_constrained = has_contacts or model.ntendon or model.neq
    x, y, z = model.body_ipos[body]
    return (
        has_only_hinges
        and bool(z)
        and x == y == 0.0
        and list(model.body_iquat[body]) == [1.0, 0.0, 0.0, 0.0]
        and not is_constrained
    )


class Variation:
    """Effect of varied quantities on the fields of a compiled model.

    `model.mass.BODY` multiplies the body's mass and inertia. `model.length.BODY` multiplies all
    distances along the body (its center of mass, attached bodies, its geoms) and, squared, its
    inertia about the transverse axes. `model.gravity` multiplies gravity and the force of a hill.
    `model.damping.JOINT` is a damping [N*s/m or N*m*s/rad] that is added to a joint.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        names: Sequence[str] = (),
        motors: Sequence[int] = (),
        vary_additions: bool = False,
    ) -> None:
        """Find the fields that the quantities `names`, from `variable_names(model)`, change.

        `motors` are the indices of actuators whose additions are not in the model; `vary_additions`
        varies these, too.
        """
        self.names = tuple(names)
        self._addresses = [joint_addresses(model, index) for index in motors]
        fields = [field for name in names for field in _FIELDS[name.split(".")[1]]]
        fields += [
            address.field
            for addresses in self._addresses
            for address in addresses
            if address is not None
        ] * vary_additions
        self._nominal = {field: field_of(model, field).copy() for field in fields}
        # Damping is added and everything else multiplied, so the neutral values are 0 and 1.
        self._neutral = np.array([float(not name.startswith("model.damping.")) for name in names])
        self._bodies = {model.body(body).name: body for body in range(model.nbody)}
        self._dofs = {
            model.joint(joint).name: model.dof_jntid == joint for joint in range(model.njnt)
        }
        self._parents = model.body_parentid.copy()
        self._geom_bodies = model.geom_bodyid.copy()
        self._geoms_along = _geoms_along_axis(model)
        self._hills = hills(model)

    def fields(
        self, values: np.ndarray, additions: np.ndarray | None = None, shown: bool = False
    ) -> dict[str, np.ndarray]:
        """Return the varied fields, shape (m, ...), by name (`opt.` before an option's).

        `values`, shape (m, k), has a column for each of `names`, NaN for the nominal value;
        `additions` are as in `arms_and_additions`; `shown` includes the `VISUAL_FIELDS`.
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
            body, scale = self._bodies.get(target), column[:, np.newaxis]
            if kind == "mass":
                fields["body_mass"][:, body] *= column
                fields["body_inertia"][:, body] *= scale
            elif kind == "length":
                fields["body_ipos"][:, body] *= scale
                fields["body_inertia"][:, body, :2] *= scale**2
                fields["body_pos"][:, self._parents == body] *= scale[:, np.newaxis]
                for geom in (
                    np.flatnonzero(self._geom_bodies == body).tolist()
                    if "geom_pos" in fields
                    else ()
                ):
                    fields["geom_pos"][:, geom, 2] *= column
                    if geom in self._geoms_along:
                        fields["geom_size"][:, geom, self._geoms_along[geom]] *= column
            elif kind == "damping":
                fields["dof_damping"][:, self._dofs[target]] += scale
            else:
                fields["opt.gravity"] *= scale
                for joint in self._hills:
                    fields["jnt_user"][:, joint, GRAVITY] *= column
        for motor, addresses in enumerate(self._addresses if additions is not None else ()):
            for entry, address in enumerate(addresses):
                if address is not None and address.field in fields:
                    fields[address.field][:, address.field_index] += (
                        additions[:, motor, entry] * address.scale  # type: ignore[index]
                    )
        return fields


def _geoms_along_axis(model: mujoco.MjModel) -> dict[int, int]:
    """Return geom -> index in `geom_size` of the half length, for geoms along the body's z axis."""
    kinds = mujoco.mjtGeom
    entries = {
        # Indices in `geom_size` of half the length along the geom's z axis.
        int(kinds.mjGEOM_CAPSULE): 1,
        int(kinds.mjGEOM_CYLINDER): 1,
        int(kinds.mjGEOM_BOX): 2,
    }
    entries_by_geom = {}
    for geom in range(model.ngeom):
        matrix = np.empty(9)
        mujoco.mju_quat2Mat(matrix, model.geom_quat[geom])
        kind = int(model.geom_type[geom])
        if kind in entries and abs(matrix[8]) > 1.0 - 1e-9:
            entries_by_geom[geom] = entries[kind]
    return entries_by_geom


def field_of(model: mujoco.MjModel, name: str) -> np.ndarray:
    """Return a live field of a model, by its name in `Variation.fields`."""
    owner = model.opt if name.startswith("opt.") else model
    field: np.ndarray = getattr(owner, name.removeprefix("opt."))
    return field


def write_fields(model: mujoco.MjModel, fields: Mapping[str, np.ndarray], row: int = 0) -> None:
    """Write one row of varied fields into a model; fields derived from them are not updated."""
    for name, values in fields.items():
        setattr(
            model.opt if name.startswith("opt.") else model, name.removeprefix("opt."), values[row]
        )
