"""A replay stores the poses that MuJoCo computes."""

import mujoco
import numpy as np
import pytest

from codrl_mj.envs.single import ActuatedEnv
from codrl_mj.viz.replay import motion
from codrl_mj.viz.replay.scene import read_mesh, simplify_mesh, visible_shapes

ARM = """
<mujoco>
  <asset>
    <texture name="half" type="2d" builtin="flat" rgb1=".5 .5 .5" rgb2=".5 .5 .5"
             width="8" height="8"/>
    <material name="red" rgba="1 0 0 1"/>
    <material name="grey" texture="half" rgba="1 1 1 1"/>
    <hfield name="ground" nrow="2" ncol="3" size="3 2 5 1" elevation="0 .5 1  0 .5 1"/>
  </asset>
  <worldbody>
    <camera name="side" pos="0 -3 0" xyaxes="1 0 0 0 0 1"/>
    <geom name="floor" type="plane" size="0 0 1" material="grey"/>
    <geom name="post" type="box" size=".1 .2 .3" rgba="0 1 0 .5"/>
    <geom name="hidden" type="box" size="1 1 1" group="3"/>
    <geom name="ground" type="hfield" hfield="ground" pos="9 0 0"/>
    <body name="upper" pos="0 0 1">
      <joint axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 .3 0 .4" size=".05" material="red"/>
      <body name="lower" pos=".3 0 .4" euler="10 20 30">
        <joint axis="1 1 0"/>
        <geom type="sphere" size=".2"/>
        <site name="tip" pos="0 0 .3" size=".02"/>
      </body>
    </body>
    <body name="ball" pos="2 0 2"><freejoint/><geom type="ellipsoid" size=".1 .2 .3"/></body>
  </worldbody>
</mujoco>
"""


@pytest.fixture(scope="module")
def arm():
    return mujoco.MjModel.from_xml_string(ARM)


def positions(model, count, seed=0):
    """Return random `qpos` with unit quaternions."""
    generator, data = np.random.default_rng(seed), mujoco.MjData(model)
    rows = []
    for _ in range(count):
        mujoco.mj_integratePos(model, data.qpos, generator.normal(size=model.nv), 1.0)
        rows.append(data.qpos.copy())
    return np.array(rows)


def test_poses_are_those_of_mujoco(arm):
    states, time = positions(arm, 30), np.arange(30) / 30
    recorded, data = motion(arm, states, time), mujoco.MjData(arm)
    assert [arm.body(int(body)).name for body in recorded.bodies] == ["upper", "lower", "ball"]
    np.testing.assert_array_equal(recorded.time, time)
    for state, poses in zip(states, recorded.poses, strict=True):
        data.qpos[:] = state
        mujoco.mj_kinematics(arm, data)
        np.testing.assert_allclose(poses[:, :3], data.xpos[recorded.bodies], atol=1e-6)
        # A quaternion and its negative are the same rotation.
        same = np.abs((poses[:, 3:] * data.xquat[recorded.bodies]).sum(axis=1))
        np.testing.assert_allclose(same, 1.0, atol=1e-6)
    assert ((recorded.poses[1:, :, 3:] * recorded.poses[:-1, :, 3:]).sum(axis=2) >= -1e-6).all()


def test_instants_are_thinned_out_but_include_the_last(arm):
    time = np.arange(0, 1001) * 0.002
    recorded = motion(arm, positions(arm, 1001), time)
    assert recorded.time[0] == 0.0
    assert recorded.time[-1] == 2.0
    # The stride is the largest number of steps that is at most 1/30 s.
    assert np.diff(recorded.time)[:-1] == pytest.approx(0.032)
    slow = motion(arm, positions(arm, 5), np.arange(5) * 0.2)
    assert len(slow.time) == 5
    later = motion(arm, positions(arm, 5), 100.0 + np.arange(5) * 0.2)
    np.testing.assert_allclose(later.time, slow.time, atol=1e-12)
    for times in ([0.0, 0.1, 0.1], [0.2, 0.1, 0.0], [0.0, 0.1, np.nan]):
        with pytest.raises(ValueError, match="time: must be finite, and ascend"):
            motion(arm, positions(arm, 3), times)


def test_visible_shapes_are_those_that_mujoco_shows(arm):
    shapes_by_name = {
        arm.geom(shape.geom).name or str(shape.geom): shape
        for shape in visible_shapes(arm)
        if shape.geom is not None
    }
    assert "hidden" not in shapes_by_name
    # The mean color of its texture.
    assert shapes_by_name["floor"].colour == pytest.approx((0.5, 0.5, 0.5, 1), abs=0.01)
    assert shapes_by_name["floor"].chequered
    assert shapes_by_name["post"].colour == pytest.approx((0, 1, 0, 0.5))
    capsule = next(shape for shape in shapes_by_name.values() if shape.kind == "capsule")
    assert capsule.colour == (1, 0, 0, 1)
    assert capsule.size[:2] == pytest.approx((0.05, 0.25))  # half of |(.3, 0, .4)|
    assert [shape.kind for shape in visible_shapes(arm) if shape.geom is None] == [
        "ellipsoid"
    ]  # the site


def test_a_height_field_has_its_heights(arm):
    vertices, triangles = read_mesh(arm, "hfield", 0)
    np.testing.assert_allclose(vertices.min(axis=0), [-3, -2, 0])
    np.testing.assert_allclose(vertices.max(axis=0), [3, 2, 5])
    assert len(triangles) == 2 * 2 * 1
    a, b, c = np.moveaxis(vertices[triangles], 1, 0)
    normals = np.cross(b - a, c - a)
    assert (normals[:, 2] > 0).all()
    assert normals[:, 2].sum() / 2 == pytest.approx(6 * 4)  # seen from above they cover all, once


def test_the_mountain_car_is_on_its_hill():
    """Compare with the geoms, which a callback moves along the hill, unlike the body."""
    env = ActuatedEnv("mountain_car", "ideal")
    states = np.array([[x, 0.0] for x in (-1.1, -0.5, 0.4)])

    def show(state):
        env.physics.show(state)
        return env.data

    recorded = motion(env.model, states, np.arange(3.0), show=show)
    ((index, car),) = [(index, body) for index, body in enumerate(recorded.bodies) if body != 0]
    for state, poses in zip(states, recorded.poses, strict=True):
        show(state)
        for shape in recorded.shapes:
            if shape.body != car or shape.geom is None:
                continue
            offset = np.empty(3)
            mujoco.mju_rotVecQuat(offset, shape.position, poses[index, 3:].astype(float))
            np.testing.assert_allclose(
                poses[index, :3] + offset, env.data.geom_xpos[shape.geom], atol=1e-6
            )
    assert np.ptp(recorded.poses[:, index, 2]) > 0.1


def test_a_simplified_mesh_keeps_its_shape():
    angles = np.linspace(0, np.pi, 200)
    turns = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    vertices = np.array(
        [[np.sin(a) * np.cos(t), np.sin(a) * np.sin(t), np.cos(a)] for a in angles for t in turns]
    )
    row, column = np.meshgrid(np.arange(199), np.arange(400), indexing="ij")
    corner, next_column = row * 400 + column, row * 400 + (column + 1) % 400
    triangles = np.concatenate(
        [
            np.stack([corner, next_column, corner + 400], 2),
            np.stack([next_column, next_column + 400, corner + 400], 2),
        ]
    ).reshape(-1, 3)
    simple_vertices, corners = simplify_mesh(vertices, triangles, 4000)
    assert 1500 < len(corners) <= 4000
    assert corners.max() < len(simple_vertices)
    np.testing.assert_allclose(np.linalg.norm(simple_vertices, axis=1), 1.0, atol=0.01)
    a, b, c = np.moveaxis(simple_vertices[corners], 1, 0)
    assert np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2 == pytest.approx(
        4 * np.pi, rel=0.05
    )
    assert simplify_mesh(vertices, triangles, len(triangles))[1] is triangles


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"time": np.arange(4.0)}, "there are 3 for 4 instants"),
        ({"states": np.zeros((3, 2))}, "must begin with the model's 9 of qpos"),
        ({"camera": "sied"}, "the model's cameras are side"),
    ],
)
def test_inconsistent_arguments_are_refused(arm, change, message):
    with pytest.raises(ValueError, match=message):
        motion(**({"model": arm, "states": positions(arm, 3), "time": np.arange(3.0)} | change))
