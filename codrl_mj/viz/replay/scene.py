"""Scene of a model: geoms and sites as shapes, meshes, poses of bodies, and the initial view."""

import dataclasses
from collections.abc import Collection
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import ArrayLike

_MUJOCO_ELEVATION, _ELEVATION = -45.0, -20.0
"""Elevation of the free camera [degrees]: MuJoCo's default, and the value that replaces it.

The default looks too steeply down on a robot.
"""
_GEOM = mujoco.mjtGeom
_KIND_OF_GEOM = {
    int(_GEOM.mjGEOM_PLANE): "plane",
    int(_GEOM.mjGEOM_SPHERE): "ellipsoid",
    int(_GEOM.mjGEOM_CAPSULE): "capsule",
    int(_GEOM.mjGEOM_ELLIPSOID): "ellipsoid",
    int(_GEOM.mjGEOM_CYLINDER): "cylinder",
    int(_GEOM.mjGEOM_BOX): "box",
    int(_GEOM.mjGEOM_HFIELD): "mesh",
    int(_GEOM.mjGEOM_MESH): "mesh",
    int(_GEOM.mjGEOM_SDF): "mesh",
}
# MuJoCo's viewers show the first three of six groups by default.
_NUM_VISIBLE_GROUPS = 3
_DEFAULT_RGBA = (0.5, 0.5, 0.5, 1.0)
TRIANGLES = 60_000
"""Maximum number of triangles of all meshes of a replay together."""


@dataclasses.dataclass(frozen=True)
class Shape:
    """A geom or a site."""

    kind: str
    """`plane`, `ellipsoid`, `capsule`, `cylinder`, `box` or `mesh`."""
    size: tuple[float, ...]
    """Half sizes as in MuJoCo [m]."""
    colour: tuple[float, ...]
    """Red, green, blue, opacity, each from 0 to 1."""
    body: int
    """Index of its body."""
    position: np.ndarray
    """Position in the frame of its body [m], shape (3,)."""
    orientation: np.ndarray
    """Orientation in the frame of its body: quaternion w, x, y, z."""
    geom: int | None = None
    """Index of the geom; None for a site."""
    mesh: tuple[str, int] | None = None
    """Kind of a mesh, `mesh` or `hfield`, and its index."""
    chequered: bool = False
    """True if the model has a texture on it."""


def visible_shapes(model: mujoco.MjModel) -> list[Shape]:
    """Return the geoms and sites that MuJoCo's viewers show by default.

    These are groups 0 to 2, without transparent ones.
    """
    shapes = []
    for kind in ("geom", "site"):
        columns = {
            name: getattr(model, f"{kind}_{name}")
            for name in ("type", "size", "rgba", "matid", "bodyid", "pos", "quat", "group")
        }
        for index in range(len(columns["type"])):
            row = {name: values[index] for name, values in columns.items()}
            colour, has_texture = _shape_color(model, row["rgba"], int(row["matid"]))
            name = _KIND_OF_GEOM.get(int(row["type"]))
            if name is None or colour[3] == 0.0 or row["group"] >= _NUM_VISIBLE_GROUPS:
                continue
            size = (
                np.repeat(row["size"][:1], 3) if row["type"] == _GEOM.mjGEOM_SPHERE else row["size"]
            )
            mesh = None
            if name == "mesh":
                mesh = (
                    "hfield" if row["type"] == _GEOM.mjGEOM_HFIELD else "mesh",
                    int(model.geom_dataid[index]),
                )
            geom = index if kind == "geom" else None
            pose = row["pos"].copy(), row["quat"].copy()
            shapes.append(
                Shape(
                    name,
                    tuple(size.tolist()),
                    colour,
                    int(row["bodyid"]),
                    *pose,
                    geom,
                    mesh,
                    has_texture,
                )
            )
    return shapes


def _shape_color(
    model: mujoco.MjModel, rgba: ArrayLike, material: int
) -> tuple[tuple[float, ...], bool]:
    """Return a shape's color, times the mean color of its texture, and True if it has a texture.

    The color is chosen as in MuJoCo.
    """
    color = np.array(rgba, dtype=float)
    if material < 0:
        return tuple(color.tolist()), False
    # MuJoCo uses the material's color only if the geom has the default one.
    if tuple(color) == _DEFAULT_RGBA:
        color = np.array(model.mat_rgba[material], dtype=float)
    textures = [int(texture) for texture in model.mat_texid[material] if texture >= 0]
    if textures:
        begin, channels = int(model.tex_adr[textures[0]]), int(model.tex_nchannel[textures[0]])
        count = int(model.tex_width[textures[0]] * model.tex_height[textures[0]])
        pixels = model.tex_data[begin : begin + count * channels].reshape(count, channels)
        color[:3] *= pixels[:, : min(channels, 3)].mean(axis=0) / 255
    return tuple(color.tolist()), bool(textures)


def read_mesh(model: mujoco.MjModel, kind: str, index: int) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices [m], shape (n, 3), and triangles, shape (m, 3), of a mesh or height field."""
    if kind == "hfield":
        rows, columns = int(model.hfield_nrow[index]), int(model.hfield_ncol[index])
        begin, (x, y, top, _) = int(model.hfield_adr[index]), model.hfield_size[index]
        heights = model.hfield_data[begin : begin + rows * columns] * top
        across, along = np.meshgrid(np.linspace(-x, x, columns), np.linspace(-y, y, rows))
        corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
        faces = np.concatenate(
            [
                np.stack([corner, corner + 1, corner + columns], 1),
                np.stack([corner + 1, corner + columns + 1, corner + columns], 1),
            ]
        )
        return np.stack([across.ravel(), along.ravel(), heights], 1), faces
    vertex, face = int(model.mesh_vertadr[index]), int(model.mesh_faceadr[index])
    return (
        model.mesh_vert[vertex : vertex + model.mesh_vertnum[index]].copy(),
        model.mesh_face[face : face + model.mesh_facenum[index]].copy(),
    )


def simplify_mesh(
    vertices: np.ndarray, triangles: np.ndarray, max_triangles: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return a mesh with a maximum number of triangles, by merging vertices.

    All vertices in a cell of a grid are replaced by their mean (Rossignac and Borrel,
    Multi-resolution 3D approximations for rendering complex scenes, 1993).
    """
    cells = 512
    while len(triangles) > max_triangles and cells > 2:
        low, span = vertices.min(axis=0), max(float(np.ptp(vertices, axis=0).max()), 1e-12)
        grid = np.minimum((vertices - low) * (cells / span), cells - 1).astype(np.int64)
        _, cell_of_vertex, counts = np.unique(
            grid @ [1, cells, cells**2], return_inverse=True, return_counts=True
        )
        means = np.stack(
            [np.bincount(cell_of_vertex, column) / counts for column in vertices.T], axis=1
        )
        merged = cell_of_vertex[triangles]
        # A triangle with two corners in one cell has collapsed to a line.
        is_triangle = (merged != np.roll(merged, 1, axis=1)).all(axis=1)
        if is_triangle.sum() <= max_triangles:
            return means, np.unique(merged[is_triangle], axis=0)
        cells = int(cells / 1.25)
    return vertices, triangles


def read_poses(data: mujoco.MjData, shapes: list[Shape], poses: np.ndarray) -> None:
    """Write the poses of all bodies into `poses` (positions and quaternions, shape (bodies, 7)).

    The kinematics must be up to date. The pose of a body is derived from its first geom, because a
    callback may have moved the geom along a hill.
    """
    poses[:, :3], poses[:, 3:] = data.xpos, data.xquat
    first_shape = {
        shape.body: shape
        for shape in reversed(shapes)
        if shape.geom is not None and shape.body != 0
    }
    for body, shape in first_shape.items():
        rotation, inverse_position, inverse_rotation = np.empty(4), np.empty(3), np.empty(4)
        mujoco.mju_mat2Quat(rotation, data.geom_xmat[shape.geom])
        mujoco.mju_negPose(inverse_position, inverse_rotation, shape.position, shape.orientation)
        mujoco.mju_mulPose(
            poses[body, :3],
            poses[body, 3:],
            data.geom_xpos[shape.geom],
            rotation,
            inverse_position,
            inverse_rotation,
        )


class Viewpoint(NamedTuple):
    """Position, target and field of view of a camera."""

    eye: np.ndarray
    """Position [m]."""
    target: np.ndarray
    """Target [m]."""
    fovy: float
    """Vertical field of view [degrees]."""
    extent: float
    """Radius of the moving bodies around their center [m]."""


def initial_view(
    model: mujoco.MjModel,
    shapes: list[Shape],
    poses: np.ndarray,
    moving: Collection[int],
    camera: str | None,
) -> Viewpoint:
    """Return the view of a named camera, or of MuJoCo's free camera moved near the moving bodies.

    The poses are of all bodies, position and quaternion, shape (bodies, 7).
    """
    bounds = []
    for shape in shapes:
        if shape.geom is not None and shape.body in moving:
            offset = np.empty(3)
            mujoco.mju_rotVecQuat(offset, shape.position, poses[shape.body, 3:])
            middle, radius = poses[shape.body, :3] + offset, model.geom_rbound[shape.geom]
            bounds += [middle - radius, middle + radius]
    center, extent = np.array(model.stat.center), float(model.stat.extent)
    # Center on the bounding box of the moving bodies; static scenery may be much larger.
    if bounds:
        low, high = np.min(bounds, axis=0), np.max(bounds, axis=0)
        center, extent = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
    if camera is not None:
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_camlight(model, data)
        index = model.camera(camera).id
        eye, forward = data.cam_xpos[index].copy(), -data.cam_xmat[index].reshape(3, 3)[:, 2]
        ahead = max(float((center - eye) @ forward), 0.5 * extent)
        return Viewpoint(eye, eye + ahead * forward, float(model.cam_fovy[index]), extent)
    free = model.vis.global_
    elevation_degrees = _ELEVATION if free.elevation == _MUJOCO_ELEVATION else free.elevation
    azimuth, elevation = np.radians([free.azimuth, elevation_degrees])
    forward = np.array(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ]
    )
    return Viewpoint(center - 2.6 * extent * forward, center, 45.0, extent)
