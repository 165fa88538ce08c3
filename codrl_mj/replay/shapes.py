"""What is seen of a model: its geoms and sites as shapes, and its meshes, thinned out to a size that fits a page."""

import dataclasses
from typing import Any

import mujoco
import numpy as np

_GEOM = mujoco.mjtGeom
_NAMES = {
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
_SHOWN_GROUPS = 3  # as in MuJoCo's viewers, the first of six
_UNPAINTED = (0.5, 0.5, 0.5, 1.0)
TRIANGLES = 60_000
"""That all meshes of a replay have at most, together."""


@dataclasses.dataclass(frozen=True)
class Shape:
    """A geom or a site."""

    kind: str
    """`plane`, `ellipsoid`, `capsule`, `cylinder`, `box` or `mesh`."""
    size: tuple[float, ...]
    """As MuJoCo has it: half sizes [m]."""
    colour: tuple[float, ...]
    """Red, green, blue, opacity, each from 0 to 1."""
    body: int
    """Whose it is."""
    position: np.ndarray
    """In its body's frame [m], shape (3,)."""
    orientation: np.ndarray
    """In its body's frame: quaternion w, x, y, z."""
    geom: int | None = None
    """Its index, of a geom."""
    mesh: tuple[str, int] | None = None
    """Of a mesh: `mesh` or `hfield`, and its index."""
    chequered: bool = False
    """Whether the model has a picture on it."""


def shapes(model: mujoco.MjModel) -> list[Shape]:
    """What MuJoCo's viewers show of a model by default: geoms and sites of groups 0 to 2 that are not transparent."""
    found = []
    for kind in ("geom", "site"):
        column = {
            name: getattr(model, f"{kind}_{name}")
            for name in ("type", "size", "rgba", "matid", "bodyid", "pos", "quat", "group")
        }
        for index in range(len(column["type"])):
            one = {name: values[index] for name, values in column.items()}
            colour, pictured = _colour(model, one["rgba"], int(one["matid"]))
            name = _NAMES.get(int(one["type"]))
            if name is None or colour[3] == 0.0 or one["group"] >= _SHOWN_GROUPS:
                continue
            size = np.repeat(one["size"][:1], 3) if one["type"] == _GEOM.mjGEOM_SPHERE else one["size"]
            mesh = None
            if name == "mesh":
                mesh = "hfield" if one["type"] == _GEOM.mjGEOM_HFIELD else "mesh", int(model.geom_dataid[index])
            geom = index if kind == "geom" else None
            place = one["pos"].copy(), one["quat"].copy()
            found.append(Shape(name, tuple(size.tolist()), colour, int(one["bodyid"]), *place, geom, mesh, pictured))
    return found


def _colour(model: mujoco.MjModel, rgba: Any, material: int) -> tuple[tuple[float, ...], bool]:
    """A shape's colour, as MuJoCo chooses it, times the mean of its picture; and whether it has one."""
    own = np.array(rgba, dtype=float)
    if material < 0:
        return tuple(own.tolist()), False
    if tuple(own) == _UNPAINTED:
        own = np.array(model.mat_rgba[material], dtype=float)
    textures = [int(one) for one in model.mat_texid[material] if one >= 0]
    if textures:
        begin, channels = int(model.tex_adr[textures[0]]), int(model.tex_nchannel[textures[0]])
        count = int(model.tex_width[textures[0]] * model.tex_height[textures[0]])
        pixels = model.tex_data[begin : begin + count * channels].reshape(count, channels)
        own[:3] *= pixels[:, : min(channels, 3)].mean(axis=0) / 255
    return tuple(own.tolist()), bool(textures)


def mesh(model: mujoco.MjModel, kind: str, index: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [m], shape (n, 3), and triangles, shape (m, 3), of a mesh or of a height field."""
    if kind == "hfield":
        return _height_field(model, index)
    vertex, face = int(model.mesh_vertadr[index]), int(model.mesh_faceadr[index])
    return (
        model.mesh_vert[vertex : vertex + model.mesh_vertnum[index]].copy(),
        model.mesh_face[face : face + model.mesh_facenum[index]].copy(),
    )


def _height_field(model: mujoco.MjModel, index: int) -> tuple[np.ndarray, np.ndarray]:
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


def thinned(vertices: np.ndarray, triangles: np.ndarray, most: int) -> tuple[np.ndarray, np.ndarray]:
    """A mesh of at most some number of triangles: vertices that share a cell of a grid become one, in their midst.

    (Rossignac and Borrel, Multi-resolution 3D approximations for rendering complex scenes, 1993.)
    """
    cells = 512
    while len(triangles) > most and cells > 2:
        low, span = vertices.min(axis=0), max(float(np.ptp(vertices, axis=0).max()), 1e-12)
        grid = np.minimum((vertices - low) * (cells / span), cells - 1).astype(np.int64)
        _, places, counts = np.unique(grid @ [1, cells, cells**2], return_inverse=True, return_counts=True)
        middles = np.stack([np.bincount(places, column) / counts for column in vertices.T], axis=1)
        merged = places[triangles]
        whole = (merged != np.roll(merged, 1, axis=1)).all(axis=1)
        if whole.sum() <= most:
            return middles, np.unique(merged[whole], axis=0)
        cells = int(cells / 1.25)
    return vertices, triangles
