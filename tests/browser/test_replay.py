"""A replay in Chromium: it plays, is scrubbed, is turned, and follows an external clock."""

import io

import mujoco
import numpy as np
import pytest
from PIL import Image

from codrl_mj.viz.replay import SCRIPT, library_script, motion, replay_html, write_replay
from tests.browser.waiting import until
from tests.viz.replay.test_motion import ARM, positions

pytestmark = pytest.mark.browser


@pytest.fixture(scope="module")
def recorded():
    model = mujoco.MjModel.from_xml_string(ARM)
    return motion(model, positions(model, 60), np.arange(60) / 30)


@pytest.fixture(scope="module")
def page_file(recorded, tmp_path_factory):
    return write_replay(recorded, tmp_path_factory.mktemp("replay") / "arm.html", "arm & co")


CLOCKED = """<!DOCTYPE html><title>report</title><link rel="icon" href="data:,">
<div id="one">{part}</div><div id="other">{part}</div>
<script>{library_script}</script>
<script>
const clocks = ["one", "other"].map((id) => {{
  const element = document.getElementById(id), seek = () => {{}};
  {script}
  return setTime;
}});
const setAll = (time) => clocks.forEach((clock) => clock(time));
</script>"""


def picture(page):
    page.wait_for_timeout(300)
    return np.asarray(
        Image.open(io.BytesIO(page.locator(".replay").screenshot())).convert("RGB")
    ).astype(int)


def poses(page):
    return np.array(
        page.evaluate(
            """document.querySelector(".replay").replay.groups.map(({position: p, quaternion: q}) =>
            [p.x, p.y, p.z, q.w, q.x, q.y, q.z])"""
        )
    )


def test_it_shows_the_recorded_poses_and_interpolates(recorded, page_file, opened):
    page = opened(page_file.as_uri())
    for index in (0, 17, 59):
        page.evaluate(f"replay.seek({float(recorded.time[index])!r})")
        np.testing.assert_allclose(poses(page), recorded.poses[index], atol=1e-4)
    page.evaluate(f"replay.seek({float(recorded.time[20] + recorded.time[21]) / 2!r})")
    middle = (recorded.poses[20] + recorded.poses[21]) / 2
    np.testing.assert_allclose(poses(page)[:, :3], middle[:, :3], atol=1e-4)


def test_it_plays_at_the_chosen_speed_and_stops_at_the_end(page_file, opened):
    page = opened(page_file.as_uri())
    page.select_option("#speed", "4")
    page.clock.install(time=0)
    page.clock.pause_at(3_600_000)  # ms; from here on only `run_for` advances the time
    page.click("#play")
    page.clock.run_for(250)  # ms
    # The first frame only sets the start, so up to two frames are missing.
    assert page.evaluate("replay.now()") == pytest.approx(4 * 0.25, abs=4 * 2 / 60)
    page.clock.run_for(500)
    assert page.evaluate("replay.now()") == pytest.approx(59 / 30, abs=1e-3)
    assert page.inner_text("#play") == "Play"
    page.click("#play")
    page.clock.run_for(100)
    assert page.evaluate("replay.playing() && replay.now() < 0.5")  # restarted from the beginning


def test_the_picture_moves_with_the_time_and_with_the_mouse(page_file, opened):
    page = opened(page_file.as_uri())
    first = picture(page)
    assert first.std() > 10
    page.evaluate("replay.seek(1.0)")
    later = picture(page)
    assert (np.abs(later - first).max(axis=2) > 20).mean() > 0.002
    box = page.locator("canvas").bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 200, y + 20, steps=5)
    page.mouse.up()
    turned = picture(page)
    assert (np.abs(turned - later).max(axis=2) > 20).mean() > 0.02
    page.click('[data-do="reset"]')
    page.mouse.move(5, 5)
    assert (np.abs(picture(page) - later).max(axis=2) > 20).mean() < 0.01


def test_keys_do_what_buttons_do(page_file, opened):
    page = opened(page_file.as_uri())
    page.keyboard.press("End")
    assert page.evaluate("replay.now()") == pytest.approx(59 / 30, abs=1e-3)
    page.keyboard.press("Home")
    page.keyboard.press("ArrowRight")
    assert page.evaluate("replay.now()") == pytest.approx(1 / 30)
    page.keyboard.press("+")
    assert page.input_value("#speed") == "2"
    page.keyboard.press(" ")
    until(page, "replay.playing()")
    page.focus("canvas")
    before = page.evaluate("document.querySelector('.replay').replay.camera.position.toArray()")
    page.keyboard.press("d")
    after = page.evaluate("document.querySelector('.replay').replay.camera.position.toArray()")
    assert np.linalg.norm(np.subtract(after, before)) > 0.01


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [390, 1280])
def test_it_fits_laptop_and_phone_light_and_dark(page_file, opened, width, scheme):
    page = opened(page_file.as_uri(), width=width, scheme=scheme)
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    shade = np.mean(picture(page)[2:8, 2:8])
    assert (shade < 90) == (scheme == "dark")
    page.click("#theme")
    assert (np.mean(picture(page)[2:8, 2:8]) < 90) == (scheme == "light")


def test_a_part_of_another_page_follows_its_clock(recorded, tmp_path, opened):
    part = replay_html(recorded, "arm")
    path = tmp_path / "report.html"
    path.write_text(CLOCKED.format(part=part, library_script=library_script(), script=SCRIPT))
    page = opened(path.as_uri())
    for index in (30, 5):
        page.evaluate(f"setAll({float(recorded.time[index])!r})")
        np.testing.assert_allclose(poses(page), recorded.poses[index], atol=1e-4)


def test_missing_webgl_is_reported(page_file, chromium):
    page = chromium.new_page()
    page.add_init_script("HTMLCanvasElement.prototype.getContext = () => null")
    page.goto(page_file.as_uri())
    assert page.locator(".replay-none").is_visible()
    page.close()
