"""A model in viser's scene, and its bodies where they are."""

from typing import Any

import numpy as np
import trimesh
import viser

from codrl_mj.replay.camera import Viewpoint, first_view
from codrl_mj.replay.motion import read_poses
from codrl_mj.replay.shapes import TRIANGLES, Shape, mesh, shapes, thinned
from codrl_mj.view.session import Session

_FLAT = ("box", "cylinder", "mesh", "plane")


class Scene:
    """What is seen of a session's model."""

    def __init__(self, server: viser.ViserServer, session: Session) -> None:
        """Send the model to whoever looks."""
        model = session.model
        self._shapes, self._poses = shapes(model), np.empty((model.nbody, 7))
        self._moving = [body for body in range(model.nbody) if model.body_weldid[body]]
        read_poses(session.data, self._shapes, self._poses)
        cameras = [model.camera(index).name for index in range(model.ncam)]
        camera = "fixed" if hasattr(session.env.unwrapped, "physics") and "fixed" in cameras else None
        self.view = first_view(model, self._shapes, self._poses, set(self._moving), camera)
        self._frames: dict[int, Any] = {}
        few = {one.mesh: thinned(*mesh(model, *one.mesh), TRIANGLES // 4) for one in self._shapes if one.mesh}
        with server.atomic():
            server.scene.set_up_direction("+z")
            server.scene.world_axes.visible = False
            for body in sorted({one.body for one in self._shapes}):
                position, quaternion = self._poses[body, :3], self._poses[body, 3:]
                frame = server.scene.add_frame(f"/{body}", show_axes=False, position=position, wxyz=quaternion)
                if body in self._moving:
                    self._frames[body] = frame
            for index, one in enumerate(self._shapes):
                vertices, triangles = few[one.mesh] if one.mesh else _triangles(one, self.view)
                opacity = one.colour[3]
                server.scene.add_mesh_simple(
                    f"/{one.body}/{index}",
                    vertices,
                    triangles,
                    color=tuple(round(255 * part) for part in one.colour[:3]),
                    opacity=opacity if opacity < 1 else None,
                    flat_shading=one.kind in _FLAT,
                    side="double" if one.kind in ("mesh", "plane") else "front",
                    cast_shadow=one.kind != "plane",
                    position=one.position,
                    wxyz=one.orientation,
                )
        server.initial_camera.position, server.initial_camera.look_at = self.view.eye, self.view.at
        server.initial_camera.up = np.array([0.0, 0.0, 1.0])
        server.initial_camera.fov = np.radians(self.view.fovy)

    def update(self, server: viser.ViserServer, session: Session) -> None:
        """Move the bodies to where they are."""
        read_poses(session.data, self._shapes, self._poses)
        with server.atomic():
            for body, frame in self._frames.items():
                frame.position, frame.wxyz = self._poses[body, :3], self._poses[body, 3:]


def _triangles(one: Shape, view: Viewpoint) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles of a shape that is no mesh of the model's."""
    size = one.size
    if one.kind == "plane":
        x, y = (half if half > 0 else 20 * view.extent for half in size[:2])
        return np.array([[-x, -y, 0], [x, -y, 0], [x, y, 0], [-x, y, 0]]), np.array([[0, 1, 2], [0, 2, 3]])
    if one.kind == "box":
        made = trimesh.creation.box(2 * np.array(size))
    elif one.kind == "ellipsoid":
        made = trimesh.creation.icosphere(subdivisions=3).apply_scale(size)
    elif one.kind == "capsule":
        made = trimesh.creation.capsule(height=2 * size[1], radius=size[0])
    else:
        made = trimesh.creation.cylinder(radius=size[0], height=2 * size[1], sections=48)
    return np.asarray(made.vertices), np.asarray(made.faces)
