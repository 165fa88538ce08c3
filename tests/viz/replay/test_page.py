"""Page of a replay: complete, small, and self-contained."""

import base64
import re

import mujoco
import numpy as np
import pytest

from codrl_mj.cli import main
from codrl_mj.viz.replay import motion, replay_html, write_replay
from tests.viz.pages.parsed import ParsedPage, check_self_contained
from tests.viz.replay.test_motion import ARM, positions

EXTERNAL_REFERENCE = re.compile(
    r"""(?:src|href|action)\s*=\s*["']?(?!data:|#)[^"'\s>]+|url\((?!["']?data:)|@import|\bfetch\("""
)


@pytest.fixture(scope="module")
def recorded():
    model = mujoco.MjModel.from_xml_string(ARM)
    return motion(model, positions(model, 20), np.arange(20) / 30)


NAME = "<b>bold</b> & {{SCRIPT}} </script>"


@pytest.fixture(scope="module")
def page(recorded, tmp_path_factory):
    return write_replay(
        recorded, tmp_path_factory.mktemp("page") / "new" / "arm.html", NAME
    ).read_text(encoding="utf-8")


def content(page):
    (data,) = ParsedPage(page).data
    return data


def test_the_positions_in_the_page_are_those_of_the_motion(recorded, page):
    data = content(page)
    poses = np.frombuffer(base64.b64decode(data["poses"]), "<f4").reshape(recorded.poses.shape)
    np.testing.assert_array_equal(poses, recorded.poses)
    np.testing.assert_allclose(
        np.frombuffer(base64.b64decode(data["time"]), "<f4"), recorded.time, rtol=1e-6
    )
    assert data["bodies"] == ["upper", "lower", "ball"]
    assert sorted({shape["body"] for shape in data["shapes"] if "body" in shape}) == [0, 1, 2]
    (field,) = data["meshes"]
    grid = np.frombuffer(base64.b64decode(field["vertices"]), "<u2").reshape(-1, 3)
    vertices = np.array(field["low"]) + grid / 65535 * field["span"]
    np.testing.assert_allclose(vertices.max(axis=0), [3, 2, 5], atol=1e-3)


def test_names_are_shown_as_text(page):
    assert NAME in ParsedPage(page).text
    model = mujoco.MjModel.from_xml_string(
        ARM.replace('name="ball"', 'name="&lt;/script&gt;&lt;i&gt;"')
    )
    part = replay_html(motion(model, positions(model, 3), np.arange(3.0)), '"><i>')
    assert "</script><i>" in content(part)["bodies"]
    assert re.search(r"<i[ >]", part) is None


def test_the_page_fetches_nothing_and_is_small(page):
    check_self_contained(page)
    three = page[page.index("/* three.js") : page.index('"use strict"')]
    assert not EXTERNAL_REFERENCE.findall(page.replace(three, ""))
    assert set(re.findall(r"https?://[^\s\"'`)]+", page)) <= {"http://www.w3.org/1999/xhtml"}
    assert "The MIT License" in three
    assert len(page) < 0.7e6


def test_another_suffix_is_refused(recorded, tmp_path):
    with pytest.raises(ValueError, match=r"write arm\.html"):
        write_replay(recorded, tmp_path / "arm.txt", "arm")


def test_the_command_line_writes_a_replay(tmp_path, capsys):
    out = tmp_path / "pole.html"
    assert main(["replay", "InvertedPendulum-v5", "--out", str(out), "--seed", "3"]) == 0
    assert capsys.readouterr().out.startswith(f"wrote {out}")
    data = content(out.read_text())
    assert data["bodies"] == ["cart", "pole"]
