"""Images of environments: their content, and the errors where rendering is impossible."""

import sys
import unittest.mock

import gymnasium
import mujoco
import numpy as np
import pytest
from gymnasium.error import DependencyNotInstalled

from codrl_mj.envs.single import ActuatedEnv
from codrl_mj.physics import PHYSICS
from codrl_mj.physics.offscreen import DisplayWindow, OffscreenRenderer, RenderingUnavailableError
from codrl_mj.tasks import TASKS
from tests.tasks.faces import every_rebuilt

every_physics = pytest.mark.parametrize("physics", PHYSICS)


@pytest.fixture
def make():
    """Return a function that makes small rendering environments; they are closed after the test."""
    envs = []

    def make(task="cartpole", seed=0, **options):
        view = {"render_mode": "rgb_array", "width": 120, "height": 90, "disable_env_checker": True}
        envs.append(gymnasium.make(TASKS[task].env_id, **{**view, **options}).unwrapped)
        envs[-1].reset(seed=seed)
        envs[-1].action_space.seed(0)
        return envs[-1]

    yield make
    for env in envs:
        env.close()


@every_rebuilt
@every_physics
def test_an_image_has_its_size_follows_the_state_and_is_not_overwritten(make, task, physics):
    env = make(task, physics=physics, width=100, height=60)
    first = env.render()
    assert first.shape == (60, 100, 3)
    assert first.dtype == np.uint8
    assert first.std() > 5.0
    assert len(np.unique(first.reshape(-1, 3), axis=0)) > 20
    first_copy = first.copy()
    # Nothing has happened since the first image.
    np.testing.assert_array_equal(env.render(), first_copy)
    for _ in range(10):
        env.step(env.action_space.sample())
    later = env.render()
    assert not np.shares_memory(first, later)
    np.testing.assert_array_equal(first, first_copy)
    assert np.any(np.abs(first.astype(int) - later).max(axis=2) > 30)
    env.reset(seed=0)
    np.testing.assert_array_equal(env.render(), first)
    for _ in range(2):
        env.close()
    np.testing.assert_array_equal(env.render(), first)


@every_rebuilt
def test_both_physics_draw_the_same_picture_of_the_same_state(make, task):
    np.testing.assert_array_equal(
        *(make(task, seed=3, physics=physics).render() for physics in PHYSICS)
    )


@every_rebuilt
@every_physics
def test_rendering_changes_nothing_in_the_episode(make, task, physics):
    rendered_env, control = (make(task, physics=physics, actuator="weak") for _ in range(2))
    for _ in range(20):
        action = rendered_env.action_space.sample()
        rendered_env.render()
        outcome, expected = rendered_env.step(action), control.step(action)
        np.testing.assert_array_equal(outcome[0], expected[0])
        assert outcome[1:] == expected[1:]
        np.testing.assert_array_equal(rendered_env.state, control.state)


def test_environments_that_render_alternately_keep_their_own_views(make):
    views = [{}, {"physics": "analytic", "seed": 2}, {"camera": "close"}, {"pretty": True}]
    envs = [make(**view) for view in views]
    images = [env.render() for env in envs]
    assert all(np.any(image != images[0]) for image in images[1:])
    for _ in range(3):
        for env, image in zip(envs, images, strict=True):
            np.testing.assert_array_equal(env.render(), image)


@every_physics
def test_every_step_of_the_human_mode_is_shown_in_a_window(make, monkeypatch, physics):
    window = unittest.mock.MagicMock()
    monkeypatch.setattr("codrl_mj.envs.single.DisplayWindow", window)
    windowed, pictured = (
        make("pendulum", physics=physics, render_mode=mode) for mode in ("human", "rgb_array")
    )
    expected = [pictured.render()]
    for _ in range(3):
        windowed.step(np.array([2.0], np.float32))
        pictured.step(np.array([2.0], np.float32))
        expected.append(pictured.render())
    windowed.close()
    window.assert_called_once_with(120, 90)
    window.return_value.close.assert_called_once_with()
    calls = window.return_value.show.call_args_list
    for call, picture in zip(calls, expected, strict=True):
        np.testing.assert_array_equal(call.args[0], picture)
        assert call.args[1] == 30
    assert "HumanRendering" not in str(gymnasium.make("codrl_mj/Pendulum-v0", render_mode="human"))


def test_a_window_shows_an_image_the_right_way_round(monkeypatch):
    """Check the arrays passed to a mocked pygame, whose first axis points to the right."""
    pygame = unittest.mock.MagicMock()
    monkeypatch.setitem(sys.modules, "pygame", pygame)
    image = np.arange(18, dtype=np.uint8).reshape(2, 3, 3)
    window = DisplayWindow(3, 2)
    window.show(image, 30.0)
    pygame.display.set_mode.assert_called_once_with((3, 2))
    (array,) = pygame.surfarray.make_surface.call_args.args
    assert [array[x, y].tolist() for y in range(2) for x in range(3)] == image.reshape(
        6, 3
    ).tolist()
    pygame.time.Clock().tick.assert_called_once_with(30.0)
    call_names = [name for name, *_ in pygame.mock_calls]
    assert call_names.index("display.set_mode().blit") < call_names.index("display.flip")
    assert "display.quit" not in call_names
    window.close()
    pygame.display.quit.assert_called_once_with()


def test_pygame_shows_an_image(monkeypatch):
    pygame = pytest.importorskip("pygame")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    window = DisplayWindow(3, 2)
    image = np.arange(18, dtype=np.uint8).reshape(2, 3, 3)
    window.show(image, 1000.0)
    np.testing.assert_array_equal(
        pygame.surfarray.array3d(pygame.display.get_surface()).swapaxes(0, 1), image
    )
    window.close()
    assert not pygame.display.get_init()


def test_raises_if_pygame_is_missing_for_a_window(monkeypatch):
    monkeypatch.setitem(sys.modules, "pygame", None)
    env = gymnasium.make("codrl_mj/Pendulum-v0", render_mode="human", width=64, height=48)
    with pytest.raises(
        DependencyNotInstalled, match=r"^render_mode = 'human' needs pygame: pip install pygame-ce$"
    ):
        env.reset(seed=0)
    env.close()


def test_without_a_render_mode_there_is_a_warning_and_no_image(make):
    env = make(render_mode=None)
    with pytest.warns(UserWarning, match="render_mode='rgb_array'"):
        assert env.render() is None


def test_the_error_names_the_backend_that_was_chosen(make, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "glfw")
    monkeypatch.setattr(mujoco, "Renderer", lambda *_, **__: 1 / 0)
    env = make()
    with pytest.raises(RenderingUnavailableError, match=r"MUJOCO_GL is glfw\): ZeroDivisionError"):
        env.render()


@pytest.mark.parametrize("camera", ["fixed", "close"])
@every_rebuilt
def test_images_with_a_cached_sky_equal_mujocos_own(task, camera):
    """Compare each pixel with MuJoCo's renderer; only moving objects are drawn at each step."""
    env = ActuatedEnv(task, "ideal")
    env.reset(seed=0)
    renderer = OffscreenRenderer(env.model, 120, 90, camera)
    reference = mujoco.Renderer(env.model, 90, 120)
    for _ in range(2):
        env.step(env.action_space.sample())
        env.physics.show(env.physics.state)
        reference.update_scene(env.data, camera)
        for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
            reference.scene.flags[flag] = False
        np.testing.assert_array_equal(renderer.render(env.data), reference.render())
    renderer.close()
    reference.close()


def test_a_black_object_is_not_taken_for_the_sky():
    model = mujoco.MjModel.from_xml_string(BLACK)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    image = OffscreenRenderer(model, 64, 64).render(data)
    assert (image[32, 32] == 0).all()
    assert image[2, 2].min() > 200


BLACK = """
<mujoco>
  <asset>
    <texture type="skybox" builtin="flat" rgb1="1 1 1" rgb2="1 1 1" width="8" height="8"/>
    <material name="coal" rgba="0 0 0 1" specular="0"/>
  </asset>
  <worldbody>
    <camera name="fixed" pos="0 -3 0" xyaxes="1 0 0 0 0 1"/>
    <geom type="box" size=".5 .5 .5" material="coal"/>
  </worldbody>
</mujoco>
"""
