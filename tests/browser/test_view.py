"""The live view in Chromium."""

import collections
import threading

import numpy as np
import pytest

from codrl_mj.envs.config import EnvConfig
from codrl_mj.viz.view.browser import Browser
from codrl_mj.viz.view.session import Session
from tests.browser.waiting import until

pytestmark = pytest.mark.browser


@pytest.fixture(scope="module")
def browser():
    """Yield a live view of a pole on a motor, simulated in a thread as by the command."""
    config = EnvConfig.from_mapping(
        {"task": "InvertedPendulum-v5", "actuator": {".*": "maxon-re65"}}
    )
    live_view = Browser(Session(config, {}), 0, "pole")
    ended = threading.Event()
    thread = threading.Thread(target=lambda: live_view.run(ended.is_set))
    thread.start()
    yield live_view
    ended.set()
    thread.join()
    live_view.close()


def field(page, label):
    """Return the input next to a label."""
    return page.locator(f"xpath=//label[text()='{label}']/following::input[not(@type='hidden')][1]")


def shown(browser, page):
    browser.playing = True
    page.wait_for_selector("text=real time", timeout=60_000)


def test_it_simulates_in_real_time_and_is_paused_stepped_and_reset(browser, opened):
    page = opened(browser.url)
    shown(browser, page)
    until(
        page,
        lambda: (
            browser._real_time_factor == pytest.approx(1.0, abs=0.2) and browser.session.time > 0
        ),
    )
    page.get_by_role("button", name="Play or pause").click()
    page.wait_for_selector("text=paused")
    # An episode that has just ended would be reset by the next step.
    browser.session.auto_reset = False
    time = browser.session.time
    page.get_by_role("button", name="Step").click()
    until(
        page,
        lambda: (
            browser.session.time == pytest.approx(time + browser.session.recorder.step_duration)
        ),
    )
    browser.session.auto_reset = True
    page.get_by_role("button", name="Reset").click()
    page.wait_for_selector("text=0.00 s")
    page.get_by_role("button", name="Play or pause").click()
    page.wait_for_selector("text=plays")


def test_a_push_moves_the_pole(browser, opened):
    page = opened(browser.url)
    shown(browser, page)
    pushed = []
    original = browser.session.push
    browser.session.push = lambda *arguments: pushed.append(arguments) or original(*arguments)
    page.get_by_role("button", name="Push forth").click()
    until(page, lambda: pushed)
    del browser.session.push
    ((body, force, axis),) = pushed
    assert (body, axis) == ("pole", 0)
    assert force > 0


def test_settings_change_the_simulation_and_unstable_ones_are_reported(browser, opened):
    page = opened(browser.url)
    shown(browser, page)
    page.get_by_text("controller", exact=True).click()
    page.get_by_text("more", exact=True).nth(1).click()
    gain = page.get_by_label("kp [V/A]")
    gain.fill("1000000")
    gain.press("Enter")
    page.wait_for_selector("text=/unstable: spectral radius/")
    time = browser.session.time
    page.wait_for_timeout(500)
    assert browser.session.time == time
    gain.fill("0")
    gain.press("Enter")
    until(page, lambda: browser.session.time != time)
    page.get_by_text("supply", exact=True).click()
    voltage = field(page, "voltage [V]")
    voltage.fill("7")
    voltage.press("Enter")
    until(
        page,
        lambda: browser.session.config.actuators_by_name[".*"].supply.voltage == pytest.approx(7.0),
    )


def test_signals_that_differ_only_by_rounding_are_drawn(browser, opened):
    page = opened(browser.url)
    shown(browser, page)
    signals, browser.playing = browser.session.signals, False
    count = len(browser.session.recorder.trace_names)
    browser.session.signals = collections.deque(
        (0.01 * index, np.full((1, count), -24.0) * (1 + 1e-10 * (index % 2)))
        for index in range(50)
    )
    until(page, lambda: page.evaluate("document.querySelectorAll('.u-wrap').length") > 0)
    page.wait_for_timeout(1500)
    assert page.evaluate("1 + 1") == 2
    browser.session.signals, browser.playing = signals, True


def test_another_policy_can_be_selected(browser, opened):
    page = opened(browser.url)
    shown(browser, page)
    page.get_by_label("policy").click()
    page.get_by_role("option", name="zero").click()
    until(page, lambda: browser.session.policy_name == "zero")


@pytest.mark.parametrize(("width", "scheme"), [(1280, "light"), (390, "dark")])
def test_it_follows_the_preferred_theme_and_leaves_the_scene_visible_on_a_phone(
    browser, opened, width, scheme
):
    page = opened(browser.url, width, scheme=scheme)
    shown(browser, page)
    assert page.evaluate("document.documentElement.dataset.mantineColorScheme") == scheme
    top = page.get_by_role("button", name="Play or pause").bounding_box()["y"]
    assert (top > 0.6 * 800) == (width == 390)
