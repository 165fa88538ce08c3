"""MuJoCo's passive-force callback for joints that run over a hill, compiled to a C function by numba.

A slide joint with our signature in its user data is the horizontal position x of a body on the hill

    z(x) = height * sin(wavenumber * x)

The callback does two things, both pure functions of (mjModel, mjData):

- it adds the hill's force, -mass * gravity * cos(wavenumber * x), to the joint's `qfrc_passive`;
- it moves the body's geoms, in `data.geom_xpos` and `data.geom_xmat`, up to the hill and tilts them along it. The
  engine computes geom poses before the passive forces, so whatever draws after `mj_forward` or `mj_step` (a viewer, a
  renderer) shows the body on the hill, while the dynamics keep the one coordinate x that the task's equations have. The
  alternatives are worse: more joints need constraints that only approximate the curve, mocap bodies need Python in
  every viewer. Poses are computed from the body's, not from the geoms' last ones: a second call changes nothing.

The body's frame has x along the joint and z up; bodies attached to it stay at the height of the joint.
"""

import ctypes
import functools
import math
from typing import Any, NamedTuple

import mujoco
import numba
from numba import types

from codrl_mj.engine.families import SIGNATURE
from codrl_mj.engine.layout import check_layout, offset
from codrl_mj.engine.memory import array, f64, i32, i64, internal

HILL_NAMES = ("signature_1", "signature_2", "gravity", "wavenumber", "height")
"""What the `user` entries of one of our slide joints hold, in order: the signature (two numbers), the largest
acceleration along the hill [m/s^2], 1/(its length/2 pi) [1/m], and the height of crests over the middle [m], which is
for the eye."""
_, _, GRAVITY, WAVENUMBER, HEIGHT = range(len(HILL_NAMES))

MODEL_FIELDS = (
    "njnt",
    "nuser_jnt",
    "jnt_type",
    "jnt_qposadr",
    "jnt_dofadr",
    "jnt_bodyid",
    "jnt_user",
    "body_mass",
    "body_geomadr",
    "body_geomnum",
    "geom_pos",
    "geom_quat",
)
DATA_FIELDS = ("qpos", "qfrc_passive", "xpos", "xmat", "geom_xpos", "geom_xmat")


class HillCallback(NamedTuple):
    """The compiled callback."""

    passive: Any
    """ctypes pointer for `mjcb_passive`: adds the hill force and puts the body's geoms on the hill."""
    owners: tuple[Any, ...]
    """The numba objects that own the machine code: they must live as long as the pointer."""


@functools.cache
def compiled_hill() -> HillCallback:
    """Compile the callback on first use and keep it for the life of the process.

    Raises:
        LayoutError: the installed MuJoCo's memory is not laid out as its introspection says.
    """
    check_layout(MODEL_FIELDS, DATA_FIELDS)
    model_at = {field: offset("mjModel", field) for field in MODEL_FIELDS}
    data_at = {field: offset("mjData", field) for field in DATA_FIELDS}
    njnt_at, nuser_at, user_at = model_at["njnt"], model_at["nuser_jnt"], model_at["jnt_user"]
    type_at, qposadr_at, dofadr_at = model_at["jnt_type"], model_at["jnt_qposadr"], model_at["jnt_dofadr"]
    bodyid_at, mass_at = model_at["jnt_bodyid"], model_at["body_mass"]
    geomadr_at, geomnum_at = model_at["body_geomadr"], model_at["body_geomnum"]
    geom_pos_at, geom_quat_at = model_at["geom_pos"], model_at["geom_quat"]
    qpos_at, force_at = data_at["qpos"], data_at["qfrc_passive"]
    xpos_at, xmat_at = data_at["xpos"], data_at["xmat"]
    geom_xpos_at, geom_xmat_at = data_at["geom_xpos"], data_at["geom_xmat"]
    first, second = SIGNATURE
    slide, user_size = int(mujoco.mjtJoint.mjJNT_SLIDE), len(HILL_NAMES)

    @internal(inline="always")
    def place(model: int, data: int, body: int, height: float, slope: float) -> None:
        """Put the body's geoms at `height` over its frame, tilted by `slope` about its y axis."""
        cosine = 1.0 / math.sqrt(1.0 + slope * slope)
        sine = slope * cosine
        origin = f64(array(data, xpos_at) + 8 * 3 * body)
        frame = f64(array(data, xmat_at) + 8 * 9 * body)
        first = i32(array(model, geomadr_at))[body]
        for geom in range(first, first + i32(array(model, geomnum_at))[body]):
            local = f64(array(model, geom_pos_at) + 8 * 3 * geom)
            quat = f64(array(model, geom_quat_at) + 8 * 4 * geom)
            w, x, y, z = quat[0], quat[1], quat[2], quat[3]
            rotation = (
                (w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)),
                (2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)),
                (2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z),
            )
            position = f64(array(data, geom_xpos_at) + 8 * 3 * geom)
            matrix = f64(array(data, geom_xmat_at) + 8 * 9 * geom)
            for row in range(3):
                ahead, left, up = frame[3 * row], frame[3 * row + 1], frame[3 * row + 2]
                along, normal = cosine * ahead + sine * up, cosine * up - sine * ahead
                position[row] = origin[row] + height * up + along * local[0] + left * local[1] + normal * local[2]
                for column in range(3):
                    matrix[3 * row + column] = (
                        along * rotation[0][column] + left * rotation[1][column] + normal * rotation[2][column]
                    )

    @numba.cfunc(types.void(types.uintp, types.uintp), nogil=True, error_model="numpy")
    def passive(model: int, data: int) -> None:
        width = i64(model + nuser_at)[0]
        if width < user_size:
            return  # no joint of this model can be ours
        for joint in range(i64(model + njnt_at)[0]):
            user = f64(array(model, user_at) + 8 * joint * width)
            if user[0] != first or user[1] != second or i32(array(model, type_at))[joint] != slide:
                continue
            phase = user[WAVENUMBER] * f64(array(data, qpos_at))[i32(array(model, qposadr_at))[joint]]
            sine, cosine = math.sin(phase), math.cos(phase)
            body = i32(array(model, bodyid_at))[joint]
            mass = f64(array(model, mass_at))[body]
            f64(array(data, force_at))[i32(array(model, dofadr_at))[joint]] -= mass * user[GRAVITY] * cosine
            place(model, data, body, user[HEIGHT] * sine, user[HEIGHT] * user[WAVENUMBER] * cosine)

    generic = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p)
    return HillCallback(generic(passive.address), (passive,))
