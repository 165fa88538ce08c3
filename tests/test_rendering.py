"""Films: format, size, length and content, and no file after an error."""

import contextlib
import copy
import dataclasses
import re
from types import SimpleNamespace

import imageio
import mujoco
import numpy as np
import pytest
from PIL import Image

from codrl_mj.actuators import IDEAL, DCMotorActuator, Drive, Motor
from codrl_mj.envs.config import EnvConfig
from codrl_mj.evaluation import Episode, RandomPolicy, run_episodes
from codrl_mj.physics import SimulationConfig, signal_names
from codrl_mj.physics.mjcf import task_model
from codrl_mj.physics.offscreen import OffscreenRenderer
from codrl_mj.tasks import TASKS, named_actuator
from codrl_mj.user_code import asset_path
from codrl_mj.viz.films.film import FrameRecorder, Panel, film
from codrl_mj.viz.films.strip import torque_label

WIDTH, HEIGHT = 200, 120
FRAME_HEIGHT = (
    40 + HEIGHT + 24 + 120 + 8 + 60 + 26
)  # title, scene, and the strip's legend, plots and time axis
PLOT_TOP = 40 + HEIGHT + 24
DESIRED, ACTUAL, SATURATED, VOLTAGE = (0, 114, 178), (213, 94, 0), (204, 121, 167), (0, 158, 115)
LIMITS = {"voltage": SATURATED, "current": (230, 159, 0), "temperature": (86, 180, 233)}
SIGNALS = signal_names(DCMotorActuator)


def random_panel(task="cartpole", actuator="weaker", steps=20, seed=1):
    """Return a panel with an episode of random actions of at most `steps` steps."""
    env = EnvConfig(task, named_actuator(actuator, task), max_episode_steps=steps)
    (episode,) = run_episodes(RandomPolicy(task, seed), env.build, 1, seed)
    return Panel(task, episode, title=f"{task} on {actuator}")


def constant_panel(
    desired, actual, *, saturated=False, arm=1.0, steps=40, terminated=False, states=None
):
    """Return a panel with a cart-pole episode of constant signals."""
    values = (desired, actual, actual, desired, 0.0, saturated)
    signals = {name: np.full(steps, value) for name, value in zip(SIGNALS, values, strict=True)}
    states = np.zeros((steps + 1, 4)) if states is None else states
    actuator, trace, time = (
        DCMotorActuator(Motor(arm_radius=arm)),
        {"speed": np.zeros(steps)},
        0.02 * np.arange(1, steps + 1),
    )
    acted = np.zeros(steps), np.ones(steps), np.zeros(1)
    episode = Episode(time, states, states, *acted, trace, signals, terminated, actuator)
    return Panel("cartpole", episode, title="made up")


@pytest.fixture
def filmed(monkeypatch, tmp_path):
    """Return a function that films panels and returns the frames before they are encoded.

    The encoder is replaced, and its frame rate is checked.
    """

    def film_frames(*panels, rate=None):
        frames = []

        def writer(_, fps, **__):
            assert fps == (rate or fps)
            return contextlib.nullcontext(SimpleNamespace(append_data=frames.append))

        monkeypatch.setattr(imageio, "get_writer", writer)
        film(panels, tmp_path / "film.mp4", WIDTH, HEIGHT)
        return frames

    return film_frames


def has_color(image, color, tolerance=40):
    """Return True for the pixels that nearly have a color."""
    return np.abs(image.astype(int) - color).max(axis=-1) < tolerance


def plot_area(frame, top=0, height=120):
    """Return one of the plots of a frame, by default that of the torque."""
    return frame[PLOT_TOP + top : PLOT_TOP + top + height]


def curve_row(frame, color):
    """Return the mean row of a color in the plot of the torque, and the number of such rows."""
    rows = np.flatnonzero(has_color(plot_area(frame), color).any(axis=1))
    return rows.mean(), len(rows)


# -- file -----------------------------------------------------------------------------------------


def test_an_mp4_is_h264_with_the_stated_size_rate_and_length(tmp_path):
    count, reports = 2, []
    panels, out = [random_panel(seed=seed) for seed in range(count)], tmp_path / "a" / "film.mp4"
    assert film(panels, out, WIDTH, HEIGHT, on_frame=lambda *counts: reports.append(counts)) == out
    with imageio.get_reader(out) as reader:
        metadata = reader.get_meta_data()
        frames = list(reader.iter_data())
    assert metadata["codec"] == "h264"
    assert metadata["pix_fmt"].startswith("yuv420p")
    assert metadata["size"] == (count * WIDTH, FRAME_HEIGHT)
    assert metadata["fps"] == 25.0  # CartPole's 50 steps a second, every second one
    assert len(frames) == 11  # steps 0, 2, ..., 20
    assert reports == [(index + 1, 11) for index in range(11)]
    for frame in frames:
        assert frame.shape == (FRAME_HEIGHT, count * WIDTH, 3)
        assert frame[40 : 40 + HEIGHT].mean() > 60  # the scene is not black
        assert frame[40 : 40 + HEIGHT].std() > 3  # nor of one colour
    assert all(np.abs(frame.astype(int) - frames[0]).max() > 30 for frame in frames[1:])


def test_a_gif_has_the_stated_size_rate_and_length_repeats_and_replaces_another(
    tmp_path,
):
    (tmp_path / "film.gif").write_text("old")
    out = film([random_panel()], tmp_path / "film.gif", WIDTH, HEIGHT)
    assert list(tmp_path.iterdir()) == [out]
    with Image.open(out) as image:
        assert image.format == "GIF"
        assert image.size == (WIDTH, FRAME_HEIGHT)
        assert image.n_frames == 11
        assert image.info["duration"] == 40  # ms: 25 frames a second
        assert image.info["loop"] == 0


@pytest.mark.parametrize("task", list(TASKS))
def test_every_task_can_be_filmed_at_its_frame_rate(filmed, task):
    rate = TASKS[task].render_fps
    panel, stated = random_panel(task, "default", steps=4), rate if rate <= 30 else rate / 2
    assert len(filmed(panel, rate=stated)) == (5 if rate <= 30 else 3)


def test_without_a_suffix_the_frames_are_pngs(tmp_path):
    out = film([constant_panel(1.0, 0.5, steps=8)], tmp_path / "new" / "frames", WIDTH, HEIGHT)
    frames = sorted(out.iterdir())
    assert [frame.name for frame in frames] == [f"frame_{index:05d}.png" for index in range(5)]
    for frame in frames:
        with Image.open(frame) as image:
            assert (image.format, image.size, image.mode) == ("PNG", (WIDTH, FRAME_HEIGHT), "RGB")
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["frames"]
    with pytest.raises(FileExistsError, match="frames exists already"):
        film([constant_panel(1.0, 0.5, steps=8)], out, WIDTH, HEIGHT)
    assert sorted(out.iterdir()) == frames


# -- content --------------------------------------------------------------------------------------


def test_the_last_step_is_always_shown(filmed):
    assert len(filmed(constant_panel(1.0, 0.5, steps=7))) == 5  # steps 0, 2, 4, 6, 7
    assert len(filmed(constant_panel(1.0, 0.5, steps=1))) == 2


@pytest.mark.parametrize(("desired", "actual", "arm"), [(8.0, -4.0, 1.0), (-8.0, 8.0 / 3, 0.15)])
def test_the_strip_draws_desired_and_actual_at_their_heights(filmed, desired, actual, arm):
    frame = filmed(constant_panel(desired, actual, arm=arm))[-1]
    limit = 1.15 * abs(desired)  # the plot spans minus to plus this, over 120 px
    for value, color in ((desired, DESIRED), (actual, ACTUAL)):
        row, thickness = curve_row(frame, color)
        assert thickness in (1, 2, 3, 4), color
        assert row == pytest.approx(59.5 * (1 - value / limit), abs=1.5)


@pytest.mark.parametrize(("volts", "limit_shown"), [(22.0, True), (5.0, False)])
def test_the_strip_draws_the_voltage_and_a_nearby_limit(filmed, volts, limit_shown):
    panel = constant_panel(1.0, 0.5)
    panel.episode.signals["voltage"][:] = volts
    plot = plot_area(filmed(panel)[-1], 128, 60)[:, 62 : WIDTH - 12]
    span = 1.2 * volts  # the plot spans minus to plus this, over 60 px
    drawn, limit_rows = (
        np.flatnonzero(has_color(plot, color).mean(axis=1) > 0.3) for color in (VOLTAGE, SATURATED)
    )
    assert drawn.mean() == pytest.approx(29.5 * (1 - volts / span), abs=1.5)
    limits = 29.5 * (1 - np.array([24.0, -24.0]) / span)
    assert (
        (np.abs(limit_rows[:, None] - limits) < 1.5).any(axis=0).all()
        if limit_shown
        else len(limit_rows) == 0
    )


def test_the_strip_shows_no_future(filmed):
    colored_columns = [
        int(has_color(plot_area(frame), ACTUAL).any(axis=0).sum())
        for frame in filmed(constant_panel(8.0, -4.0))
    ]
    assert colored_columns[0] <= 1
    assert colored_columns == sorted(colored_columns)
    assert colored_columns[-1] > 0.9 * (WIDTH - 62 - 10)
    assert colored_columns[len(colored_columns) // 2] == pytest.approx(
        colored_columns[-1] / 2, rel=0.1
    )


def test_a_long_episodes_strip_slides(filmed):
    panel = constant_panel(8.0, -4.0, steps=400)
    panel.episode.signals["actual_force"][:200] = 4.0
    frames = filmed(panel)
    assert curve_row(frames[50], ACTUAL)[0] < 50  # above the axis
    assert curve_row(frames[-1], ACTUAL)[0] > 70  # below it: the first half has left the window


@pytest.mark.parametrize("limit", ["voltage", "current", "temperature", "", None])
def test_saturation_is_marked_in_the_color_of_its_limit(filmed, limit):
    """Test a drive with each of its limits or none, and a current loop with its only one."""
    panel = constant_panel(8.0, -4.0, saturated=limit != "")
    if limit is not None:
        signals = panel.episode.signals | {
            f"{name}_saturated": np.full(40, float(name == limit)) for name in LIMITS
        }
        with_drive = dataclasses.replace(panel.episode, actuator=Drive(), signals=signals)
        panel = dataclasses.replace(panel, episode=with_drive)
    plot = plot_area(filmed(panel)[-1])
    for name, color in LIMITS.items():
        marked = has_color(plot, 0.3 * np.array(color) + 0.7 * 255, 12).mean()
        is_reached = limit != "" and name == (limit or "voltage")
        assert (marked > 0.3) if is_reached else (marked < 0.1), (
            name
        )  # the edges of lines are pale too


def test_a_model_without_a_sky_gets_the_default_sky(tmp_path):
    """Compare Pendulum's model with a copy without its sky."""
    bare = tmp_path / "bare.xml"
    bare.write_text(re.sub(r'<texture name="sky".*?/>', "", asset_path("pendulum.xml").read_text()))
    images = []
    for task in (TASKS["pendulum"], dataclasses.replace(TASKS["pendulum"], asset=str(bare))):
        model = task_model(SimulationConfig(task, (IDEAL,)))
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        images.append(OffscreenRenderer(model, WIDTH, HEIGHT).render(data))
    np.testing.assert_array_equal(*images)


def test_the_scene_shows_the_states(filmed):
    states = np.zeros((3, 4))
    states[2, 0] = 1.5  # the cart is at another place
    first, last = filmed(
        *(
            constant_panel(1.0, 1.0, steps=2, states=entries)
            for entries in (states, np.zeros((3, 4)))
        )
    )
    scene = slice(40, 40 + HEIGHT - 40)  # without the line of text at the end
    assert np.abs(first[scene, :WIDTH].astype(int) - last[scene, :WIDTH]).max() > 50
    np.testing.assert_array_equal(first[scene, WIDTH:], last[scene, WIDTH:])
    np.testing.assert_array_equal(first[scene, :WIDTH], first[scene, WIDTH:])


def test_a_shorter_episode_keeps_its_last_frame_and_is_marked_as_ended(filmed):
    frames = filmed(
        constant_panel(1.0, 0.5, steps=10, terminated=True), constant_panel(1.0, 0.5, steps=40)
    )
    scenes = [frame[40 : 40 + HEIGHT, :WIDTH] for frame in frames]
    assert len(frames) == 21
    for scene in scenes[6:]:
        np.testing.assert_array_equal(scene, scenes[5])
    assert not np.array_equal(scenes[4], scenes[5])
    assert has_color(scenes[5][-40:], (0xB0, 0x3A, 0x2E), 60).any()  # it says when it ended, in red
    np.testing.assert_array_equal(
        frames[1][40 : 40 + HEIGHT, :WIDTH], frames[1][40 : 40 + HEIGHT, WIDTH:]
    )


@pytest.mark.parametrize("actuator", ["weaker", "ideal"])
def test_filming_does_not_change_the_episode(filmed, actuator):
    panel = random_panel(actuator=actuator, steps=6)
    before = copy.deepcopy(vars(panel.episode))
    assert has_color(plot_area(filmed(panel)[-1]), ACTUAL).any()
    np.testing.assert_equal(vars(panel.episode), before)


@pytest.mark.parametrize(
    ("task", "actuator", "label"),
    [
        ("cartpole", "paper", "shaft torque [N·m]"),
        ("cartpole", "ideal", "joint force [N]"),
        ("pendulum", "ideal", "joint torque [N·m]"),
        ("Ant-v5", "ideal", "joint force [N, N·m]"),
    ],
)
def test_the_strip_is_labeled_with_its_torque_or_force(task, actuator, label):
    assert torque_label(task, named_actuator(actuator, "cartpole"), 0) == label


def test_the_last_tick_label_is_not_cut(filmed):
    axis = filmed(constant_panel(1.0, 0.5, steps=100))[-1][-26:]
    assert (axis[10:, -10:] < 100).any()  # "2 s", half of it beyond the plot
    assert (axis[:, -2:] == 255).all()  # and white beyond that


# -- errors ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("new/film.avi", {}, r"unknown format '\.avi'.*\.mp4, \.gif.*folder of PNG"),
        ("new/film.MP4", {}, r"unknown format '\.MP4'"),
        ("new/film.mp4", {"width": 201}, "width = 201: must be even"),
        ("new/film.mp4", {"height": 121}, "height = 121: must be even"),
        ("new/film.mp4", {"width": 64}, "width = 64: must be >= 160"),
        ("new/film.mp4", {"width": -200}, "width = -200: must be >= 160"),
        ("new/film.mp4", {"height": 0}, "height = 0: must be >= 80"),
        ("new/film.mp4", {"width": 100_000}, "width = 100000: must be an integer from 1 to"),
        ("new/film.mp4", {"camera": "close-up"}, "did you mean 'close'"),
        ("new/film.mp4", {"camera": "drone"}, "cameras are fixed, close"),
        ("new/film.mp4", {"panels": []}, "at least one episode"),
        ("file/film.mp4", {}, "file"),
    ],
)
def test_bad_arguments_are_named_and_nothing_is_written(tmp_path, name, options, message):
    (tmp_path / "file").write_text("in the way")
    arguments = {"panels": [constant_panel(1.0, 1.0)], "width": WIDTH, "height": HEIGHT} | options
    with pytest.raises((ValueError, OSError), match=message):
        film(out=tmp_path / name, **arguments)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def fail_after(count, error, function=lambda *_, **__: None):
    """Return a function that raises `error` at its call number `count`."""
    calls = iter(range(count))

    def failing(*arguments, **options):
        if next(calls, None) is None:
            raise error
        return function(*arguments, **options)

    return failing


@pytest.mark.parametrize(
    ("failure", "suffix"), [("renderer", ".mp4"), ("writer", ".mp4"), ("interrupt", ".gif")]
)
def test_a_failure_midway_keeps_the_old_file_and_frees_the_contexts(
    tmp_path, monkeypatch, failure, suffix
):
    out, on_frame, renderers, closed = tmp_path / f"film{suffix}", None, [], []
    if failure != "renderer":
        out.write_text("old")
    make, close = OffscreenRenderer.__init__, OffscreenRenderer.close
    monkeypatch.setattr(
        OffscreenRenderer,
        "__init__",
        lambda self, *a, **o: renderers.append(self) or make(self, *a, **o),
    )
    monkeypatch.setattr(OffscreenRenderer, "close", lambda self: closed.append(self) or close(self))
    error = (
        KeyboardInterrupt() if failure == "interrupt" else OSError(28, "No space left on device")
    )
    if failure == "renderer":
        monkeypatch.setattr(
            OffscreenRenderer, "render", fail_after(7, error, OffscreenRenderer.render)
        )
    elif failure == "interrupt":
        on_frame = fail_after(3, error)
    else:
        get_writer = imageio.get_writer

        def failing_writer(*arguments, **options):
            writer = get_writer(*arguments, **options)
            monkeypatch.setattr(writer, "append_data", fail_after(4, error, writer.append_data))
            return writer

        monkeypatch.setattr(imageio, "get_writer", failing_writer)
    with pytest.raises(type(error)):
        film(
            [constant_panel(1.0, 1.0), constant_panel(1.0, 1.0)],
            out,
            WIDTH,
            HEIGHT,
            on_frame=on_frame,
        )
    assert [path.read_text() for path in tmp_path.iterdir()] == (
        [] if failure == "renderer" else ["old"]
    )
    assert len(renderers) == 2
    assert all(renderer in closed for renderer in renderers)


def test_an_environment_without_images_is_refused_before_its_episode():
    with (
        contextlib.closing(EnvConfig("pendulum").build()) as env,
        pytest.raises(ValueError, match="'rgb_array' for a film"),
    ):
        FrameRecorder(env)
