"""The mountain cars' hill: its force, and the drawing of the car on it."""

import mujoco
import numpy as np
import pytest

from codrl_mj import engine
from codrl_mj.actuators import IDEAL
from codrl_mj.engine import CallbackInUseError
from codrl_mj.engine.families import SIGNATURE
from codrl_mj.physics import MujocoPhysics, SimulationConfig, hills, install_callbacks
from codrl_mj.tasks import TASKS
from tests.tasks.faces import WITH_HILL, ours

# The hill as Gymnasium draws it.
HEIGHT, WAVENUMBER, MIDDLE = 0.45, 3.0, 0.55

_SLED = """
<mujoco>
  <option gravity="0 0 0"/>
  <worldbody>
    <geom name="ground" type="plane" size="1 1 1"/>
    <body name="sled" pos="0.3 -0.2 0.1" {turned}>
      <joint name="sled" type="slide" {axis} {user}/>
      <geom name="hull" size="0.1 0.2 0.3" type="box" pos="0.1 0.2 0.3" euler="10 20 30"/>
      <geom name="skid" size="0.1" pos="0 0 0.1"/>
      <body name="rider" pos="0 0 0.5"><geom name="rider" size="0.1"/></body>
    </body>
    <body name="other">
      <joint type="slide" axis="1 0 0" stiffness="2" damping="1"/>
      <geom name="other" size="0.1"/>
    </body>
  </worldbody>
</mujoco>
"""
_SIGNATURE = " ".join(map(repr, SIGNATURE))
_OURS = f'user="{_SIGNATURE} 0.5 2 0.3"'


def _sled(turned="", axis='axis="1 0 0"', user=_OURS, x=0.4):
    model = mujoco.MjModel.from_xml_string(_SLED.format(turned=turned, axis=axis, user=user))
    data = mujoco.MjData(model)
    data.qpos[:] = x, 0.2
    data.qvel[:] = 0.1, -0.3
    return model, data


@pytest.fixture
def with_hill(bare_engine):
    engine.install("hill")


@pytest.mark.parametrize("task", WITH_HILL)
@pytest.mark.parametrize("actuator", ["ideal", "paper"])
def test_without_the_callback_there_is_no_hill(task, actuator, bare_engine):
    """From rest at x = -0.2 the hill drives the car back; without the callback it stays."""
    speeds = []
    for remove in (False, True):
        env = ours(task, actuator=actuator).unwrapped
        env.reset(seed=0)
        env.physics.reset(np.array([-0.2, 0.0]))
        if remove:
            mujoco.set_mjcb_passive(None)
        env.step(1 if task == "mountain_car" else np.zeros(1, dtype=np.float32))
        speeds.append(env.state[1])
    assert speeds[0] == pytest.approx(-0.0025 * np.cos(-0.6), rel=0.01)
    assert speeds[1] == 0.0


@pytest.mark.parametrize("task", TASKS)
def test_only_models_with_a_hill_install_its_callback(task, bare_engine):
    env = ours(task, actuator="ideal").unwrapped
    assert engine.installed("hill") == (task in WITH_HILL) == bool(hills(env.model))
    assert not engine.installed("motor")


def test_the_force_is_a_function_of_the_position(with_hill):
    model, data = _sled()
    mujoco.mj_forward(model, data)
    mass = model.body("sled").mass[0]
    expected = [-mass * 0.5 * np.cos(2 * 0.4), -2 * 0.2 - 1 * -0.3]
    np.testing.assert_allclose(data.qfrc_passive, expected, rtol=1e-15)
    before = data.qfrc_passive.copy(), data.geom_xpos.copy(), data.geom_xmat.copy()
    mujoco.mj_forward(model, data)
    mujoco.mj_forwardSkip(model, data, mujoco.mjtStage.mjSTAGE_POS, False)  # without kinematics
    for field, value in zip(("qfrc_passive", "geom_xpos", "geom_xmat"), before, strict=True):
        np.testing.assert_array_equal(getattr(data, field), value)


@pytest.mark.parametrize("turned", ["", 'euler="20 -30 40"'])
def test_the_bodys_geoms_ride_on_the_hill(turned, with_hill):
    """Compare with a body that the engine itself lifts and rotates."""
    model, data = _sled(turned)
    mujoco.mj_forward(model, data)
    plain, placed = _sled(turned, user="")
    mujoco.mj_kinematics(plain, placed)
    frame = placed.body("sled").xmat.reshape(3, 3)
    slope = 0.3 * 2 * np.cos(0.8)
    tilt = -np.arctan(slope)
    turn = np.array([[np.cos(tilt), 0, np.sin(tilt)], [0, 1, 0], [-np.sin(tilt), 0, np.cos(tilt)]])
    for name in ("hull", "skid"):
        offset = frame.T @ (placed.geom(name).xpos - placed.body("sled").xpos)
        position = placed.body("sled").xpos + frame @ (turn @ offset + [0, 0, 0.3 * np.sin(0.8)])
        rotation = frame @ turn @ frame.T @ placed.geom(name).xmat.reshape(3, 3)
        np.testing.assert_allclose(data.geom(name).xpos, position, atol=1e-14)
        np.testing.assert_allclose(data.geom(name).xmat.reshape(3, 3), rotation, atol=1e-14)
    for name in ("rider", "other", "ground"):
        np.testing.assert_array_equal(data.geom(name).xpos, placed.geom(name).xpos)


@pytest.mark.parametrize(
    ("user", "kind"),
    [
        ("", mujoco.mjtJoint.mjJNT_SLIDE),
        (f'user="{SIGNATURE[0]!r} 1 0.5 2 0.3"', mujoco.mjtJoint.mjJNT_SLIDE),
        (f'user="{_SIGNATURE} 0.5"', mujoco.mjtJoint.mjJNT_SLIDE),
        (_OURS, mujoco.mjtJoint.mjJNT_HINGE),
    ],
)
def test_the_hill_callback_does_not_change_other_models(user, kind, bare_engine):
    trajectories = []
    for parts in ((), ("hill", "motor")):
        if parts:
            engine.install(*parts)
        model, data = _sled(user=user)
        model.jnt_type[0] = kind
        mujoco.mj_step(model, data, 50)
        trajectories.append(
            [data.qpos.copy(), data.qvel.copy(), data.qfrc_passive.copy(), data.geom_xpos.copy()]
        )
    for bare, ours_installed in zip(*trajectories, strict=True):
        np.testing.assert_array_equal(bare, ours_installed)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (
            {"user": f'user="{_SIGNATURE} 1"'},
            "user = .* needs signature_1, signature_2, gravity, wavenumber, height",
        ),
        ({"axis": 'axis="0 1 0"'}, 'a hill of codrl_mj needs type="slide" and axis="1 0 0"'),
    ],
)
def test_a_joint_with_a_wrong_signature_raises(wrong, message):
    with pytest.raises(ValueError, match=f"sled: {message}"):
        hills(_sled(**wrong)[0])


def test_callbacks_of_other_libraries_are_not_replaced(bare_engine):
    def foreign(model, data):
        pass

    mujoco.set_mjcb_passive(None)
    model, _ = _sled()
    mujoco.set_mjcb_passive(foreign)
    with pytest.raises(
        CallbackInUseError, match=r"mjcb_passive is already set.*physics='analytic'"
    ):
        install_callbacks(model)
    assert mujoco.get_mjcb_passive() is foreign
    assert mujoco.get_mjcb_control() is None


@pytest.mark.parametrize("task", WITH_HILL)
@pytest.mark.parametrize("x", [-1.2, -np.pi / 6, -0.1, 0.3, 0.5])
@pytest.mark.parametrize("after", ["render", "mj_forward", "mj_step"])
def test_the_car_follows_the_hill(task, x, after):
    """Check our renderings, and the poses that any viewer draws after the engine's functions."""
    definition = TASKS[task]
    physics = MujocoPhysics(SimulationConfig(definition, [IDEAL], 1, "semi-implicit"))
    physics.reset(np.array([x, 0.0]))
    if after == "render":
        physics.show(np.array([x, 0.0]))
    else:
        getattr(mujoco, after)(physics.model, physics.data)
    chassis = physics.data.geom("chassis")
    up = chassis.xmat.reshape(3, 3)[:, 2]
    ground = chassis.xpos - 0.052 * up  # over which it sits
    np.testing.assert_allclose(ground, [x, 0, MIDDLE + HEIGHT * np.sin(WAVENUMBER * x)], atol=1e-12)
    along = np.array([1, 0, HEIGHT * WAVENUMBER * np.cos(WAVENUMBER * x)])
    np.testing.assert_allclose(up @ along, 0, atol=1e-12)
    assert up[2] > 0


@pytest.mark.parametrize("task", WITH_HILL)
def test_the_drawn_hill_is_that_of_the_callback(task):
    model = MujocoPhysics(SimulationConfig(TASKS[task], [IDEAL], 1, "semi-implicit")).model
    (joint,) = hills(model)
    np.testing.assert_array_equal(model.jnt_user[joint], [*SIGNATURE, 0.0025, WAVENUMBER, HEIGHT])
    height = model.geom("hill").pos[2] + model.hfield_size[0][2] * model.hfield_data.reshape(2, -1)
    middle, radius = model.geom("hill").pos[0], model.hfield_size[0][0]
    x = np.linspace(middle - radius, middle + radius, height.shape[1])
    np.testing.assert_allclose(height, [MIDDLE + HEIGHT * np.sin(WAVENUMBER * x)] * 2, atol=1e-3)
    goal = {"mountain_car": 0.5, "mountain_car_continuous": 0.45}[task]
    assert model.geom("pole").pos[0] == pytest.approx(goal)
    base = model.geom("pole").pos[2] - model.geom("pole").size[1]
    assert base == pytest.approx(MIDDLE + HEIGHT * np.sin(WAVENUMBER * goal), abs=1e-3)


def test_a_render_shows_the_car_move_and_climb():
    env = ours("mountain_car", render_mode="rgb_array", width=160, height=120).unwrapped
    env.reset(seed=0)
    centres = []
    for x in (-0.52, 0.3):
        env.physics.reset(np.array([x, 0.0]))
        red, green, blue = np.moveaxis(env.render().astype(int), -1, 0)
        rows, columns = np.nonzero((blue > 1.4 * red) & (blue > green) & (blue > 50))
        assert len(rows) > 10
        centres.append((rows.mean(), columns.mean()))
    env.close()
    assert centres[1][0] < centres[0][0] - 20  # higher in the image
    assert centres[1][1] > centres[0][1] + 30
