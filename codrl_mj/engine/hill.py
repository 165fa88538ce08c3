"""MuJoCo's passive-force callback for joints that run over a hill, compiled to C by numba.

A slide joint with our signature in its user data is the horizontal position x of a body on the hill

    z(x) = height * sin(wavenumber * x)

The callback does two things, and has no state of its own:

- it adds the hill's force, -mass * gravity * cos(wavenumber * x), to the joint's `qfrc_passive`;
- it moves the body's geoms, in `data.geom_xpos` and `data.geom_xmat`, up to the hill and tilts
  them along it. The engine computes geom poses before the passive forces, so a viewer or renderer
  that draws after `mj_forward` or `mj_step` shows the body on the hill, while the dynamics have
  only the coordinate x of the task's equations. The alternatives are worse: additional joints need
  constraints that only approximate the curve, and mocap bodies need Python in every viewer. The
  poses follow from the body's pose, not from the geoms' previous poses, so a second call changes
  nothing.

The body's frame has x along the joint and z up; bodies attached to it stay at the height of the
joint.
"""

import functools
import math

import mujoco
from numba import types

from codrl_mj.compile_cache import cfunc
from codrl_mj.engine.families import SIGNATURE
from codrl_mj.engine.layout import DATA, MODEL
from codrl_mj.engine.memory import CFunction, callback, entry_address, f64, internal

HILL_NAMES = ("signature_1", "signature_2", "gravity", "wavenumber", "height")
"""Entries of a hill joint's `user` data, in order: the signature (two numbers), the largest
acceleration along the hill [m/s^2], the wavenumber 2 pi/(length of a period) [1/m], and the height
of the crests over the middle [m], which only the drawing uses.
"""
_, _, GRAVITY, WAVENUMBER, HEIGHT = range(len(HILL_NAMES))
_SLIDE = int(mujoco.mjtJoint.mjJNT_SLIDE)
_FIRST, _SECOND = SIGNATURE


@internal(inline="always")
def _move_geoms(model: int, data: int, body: int, height: float, slope: float) -> None:
    """Move the body's geoms to `height` above its frame, tilted by `slope` about its y axis."""
    cosine = 1.0 / math.sqrt(1.0 + slope * slope)
    sine = slope * cosine
    origin = f64(entry_address(DATA.xpos(data), 3 * body))
    frame = f64(entry_address(DATA.xmat(data), 9 * body))
    first = MODEL.body_geomadr(model)[body]
    for geom in range(first, first + MODEL.body_geomnum(model)[body]):
        local = f64(entry_address(MODEL.geom_pos(model), 3 * geom))
        quat = f64(entry_address(MODEL.geom_quat(model), 4 * geom))
        w, x, y, z = quat[0], quat[1], quat[2], quat[3]
        rotation = (
            (w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)),
            (2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)),
            (2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z),
        )
        position = f64(entry_address(DATA.geom_xpos(data), 3 * geom))
        matrix = f64(entry_address(DATA.geom_xmat(data), 9 * geom))
        for row in range(3):
            # World coordinates of the body's axes, and of the axes along the hill and normal to it.
            ahead, left, up = frame[3 * row], frame[3 * row + 1], frame[3 * row + 2]
            along, normal = cosine * ahead + sine * up, cosine * up - sine * ahead
            position[row] = (
                origin[row] + height * up + along * local[0] + left * local[1] + normal * local[2]
            )
            for column in range(3):
                matrix[3 * row + column] = (
                    along * rotation[0][column]
                    + left * rotation[1][column]
                    + normal * rotation[2][column]
                )


@functools.cache
def hill_callbacks() -> dict[str, CFunction]:
    """Return the hill's callback by MuJoCo's name, as `motor_callbacks` does for motors."""

    @cfunc(types.void(types.uintp, types.uintp), nogil=True, error_model="numpy")
    def passive(model: int, data: int) -> None:
        width = MODEL.nuser_jnt(model)
        if width < len(HILL_NAMES):
            # Without room for our signature no joint of this model can be ours.
            return
        for joint in range(MODEL.njnt(model)):
            user = f64(entry_address(MODEL.jnt_user(model), joint * width))
            if user[0] != _FIRST or user[1] != _SECOND or MODEL.jnt_type(model)[joint] != _SLIDE:
                continue
            phase = user[WAVENUMBER] * DATA.qpos(data)[MODEL.jnt_qposadr(model)[joint]]
            sine, cosine = math.sin(phase), math.cos(phase)
            body = MODEL.jnt_bodyid(model)[joint]
            mass = MODEL.body_mass(model)[body]
            DATA.qfrc_passive(data)[MODEL.jnt_dofadr(model)[joint]] -= mass * user[GRAVITY] * cosine
            _move_geoms(
                model, data, body, user[HEIGHT] * sine, user[HEIGHT] * user[WAVENUMBER] * cosine
            )

    return {"passive": callback(passive)}
