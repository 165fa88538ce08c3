"""The page of a replay: whole, small, and asking nobody."""

import base64
import json
import re
from html.parser import HTMLParser

import mujoco
import numpy as np
import pytest

from codrl_mj.cli import main
from codrl_mj.replay import motion, replay, write_replay
from tests.replay.test_motion import ARM, positions

OUTSIDE = re.compile(r"""(?:src|href|action)\s*=\s*["']?(?!data:|#)[^"'\s>]+|url\((?!["']?data:)|@import|\bfetch\(""")


class Tags(HTMLParser):
    """Which tags there are, and the text of scripts and titles."""

    def __init__(self, text):  # noqa: D107
        super().__init__()
        self.tags, self.texts = [], {}
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))

    def handle_data(self, text):
        self.texts.setdefault(self.tags[-1][0] if self.tags else "", []).append(text)


@pytest.fixture(scope="module")
def what():
    model = mujoco.MjModel.from_xml_string(ARM)
    return motion(model, positions(model, 20), np.arange(20) / 30)


@pytest.fixture(scope="module")
def page(what, tmp_path_factory):
    path = write_replay(
        what, tmp_path_factory.mktemp("page") / "new" / "arm.html", "<b>bold</b> & {{SCRIPT}} </script>"
    )
    return path.read_text(encoding="utf-8")


def content(page):
    (text,) = re.findall(r'<script type="application/json">(.*?)</script>', page, re.DOTALL)
    return json.loads(text)


def test_the_positions_in_the_page_are_those_of_the_motion(what, page):
    data = content(page)
    poses = np.frombuffer(base64.b64decode(data["poses"]), "<f4").reshape(what.poses.shape)
    np.testing.assert_array_equal(poses, what.poses)
    np.testing.assert_allclose(np.frombuffer(base64.b64decode(data["time"]), "<f4"), what.time, rtol=1e-6)
    assert data["bodies"] == ["upper", "lower", "ball"]
    assert sorted({shape["body"] for shape in data["shapes"] if "body" in shape}) == [0, 1, 2]
    (field,) = data["meshes"]
    grid = np.frombuffer(base64.b64decode(field["vertices"]), "<u2").reshape(-1, 3)
    vertices = np.array(field["low"]) + grid / 65535 * field["span"]
    np.testing.assert_allclose(vertices.max(axis=0), [3, 2, 5], atol=1e-3)


def test_names_stand_as_text(page):
    seen = Tags(page)
    assert not [tag for tag, _ in seen.tags if tag == "b"]
    assert "".join(seen.texts["title"]).strip() == "<b>bold</b> & {{SCRIPT}} </script>"


def test_names_of_bodies_stand_as_text():
    model = mujoco.MjModel.from_xml_string(ARM.replace('name="ball"', 'name="&lt;/script&gt;&lt;i&gt;"'))
    part = replay(motion(model, positions(model, 3), np.arange(3.0)), '"><i>')
    assert "</script><i>" in content(part)["bodies"]
    assert not [tag for tag, _ in Tags(part).tags if tag == "i"]


def test_the_page_asks_nobody(page):
    three = page[page.index("/* three.js") : page.index('"use strict"')]
    assert not OUTSIDE.findall(page.replace(three, ""))
    assert set(re.findall(r"https?://[^\s\"'`)]+", page)) <= {"http://www.w3.org/1999/xhtml"}
    assert "default-src 'none'" in page
    assert "The MIT License" in three


def test_the_page_is_small(page):
    assert len(page) < 0.7e6


def test_another_suffix_is_refused(what, tmp_path):
    with pytest.raises(ValueError, match=r"write arm\.html"):
        write_replay(what, tmp_path / "arm.txt", "arm")


def test_the_command_line_writes_a_replay(tmp_path, capsys):
    out = tmp_path / "pole.html"
    assert main(["replay", "InvertedPendulum-v5", "--out", str(out), "--seed", "3"]) == 0
    assert capsys.readouterr().out.startswith(f"wrote {out}")
    data = content(out.read_text())
    assert data["bodies"] == ["cart", "pole"]
