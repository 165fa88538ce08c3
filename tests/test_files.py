"""Atomic writing of files and folders, and digests of JSON."""

import errno
import json
import os
import stat

import pytest

from codrl_mj.runs.files import atomic_write, read_json, with_digest, write_json


@pytest.mark.parametrize("existing", [None, "old and longer"], ids=["new", "there"])
@pytest.mark.parametrize("name", ["film.mp4", "policy.safetensors", "curve.tar.gz", "nosuffix"])
def test_a_file_appears_complete_when_its_block_ends(tmp_path, name, existing):
    """Until then there is a private temporary file of the same suffix beside it."""
    target = tmp_path / name
    if existing is not None:
        target.write_text(existing)
    with atomic_write(target) as temporary:
        temporary.write_text("whole")
        assert (target.read_text() if target.exists() else None) == existing
        assert (temporary.suffix, temporary.parent) == (target.suffix, tmp_path)
        assert stat.S_IMODE(temporary.stat().st_mode) == 0o600
    assert target.read_text() == "whole"
    assert list(tmp_path.iterdir()) == [target]


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt, SystemExit, OSError])
@pytest.mark.parametrize("existing", [None, "old"], ids=["new", "there"])
def test_an_exception_leaves_the_folder_as_it_was(tmp_path, error, existing):
    target = tmp_path / "result.json"
    if existing is not None:
        target.write_text(existing)
    with pytest.raises(error), atomic_write(target) as temporary:  # noqa: PT012 - partial write
        temporary.write_text("half of it")
        raise error
    assert [path.read_text() for path in tmp_path.iterdir()] == (
        [] if existing is None else [existing]
    )


def test_a_full_disk_while_writing_json_leaves_nothing(tmp_path, monkeypatch):
    def full(self, text, *_, **__):
        with self.open("w") as file:
            file.write(text[:3])
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("pathlib.Path.write_text", full)
    with pytest.raises(OSError, match="No space left"):
        write_json(tmp_path / "config.json", {"a": 1})
    assert list(tmp_path.iterdir()) == []


def test_a_failed_replacement_leaves_no_temporary_file(tmp_path):
    (tmp_path / "taken").mkdir()
    with pytest.raises(OSError, match="taken"), atomic_write(tmp_path / "taken") as temporary:
        temporary.write_text("x")
    assert [path.name for path in tmp_path.iterdir()] == ["taken"]


@pytest.mark.parametrize(
    ("mask", "mode"), [(0o022, 0o644), (0o077, 0o600), (0o002, 0o664), (0, 0o666)]
)
def test_permissions_follow_the_umask(tmp_path, mask, mode):
    before = os.umask(mask)
    try:
        with atomic_write(tmp_path / "a.txt") as temporary:
            temporary.write_text("x")
        assert os.umask(mask) == mask  # Reading the mask does not change it.
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "a.txt").stat().st_mode) == mode


def test_json_is_indented_in_new_folders_and_read_back(tmp_path):
    write_json(tmp_path / "a" / "b" / "c.json", [1])
    assert (tmp_path / "a" / "b" / "c.json").read_text() == "[\n  1\n]\n"
    content = {
        "text": "ω [rad/s]",
        "list": [1, 2.5, None, True],
        "nested": {"limit": float("inf")},
        "small": 1e-17,
    }
    write_json(tmp_path / "a.json", content)
    assert read_json(tmp_path / "a.json", "thing") == content


CONTENT = {"b": {"limit": float("inf"), 10: (1, 2.5), 9: None}, "a": [float("nan"), "ω"], "seed": 3}


def test_content_with_a_digest_is_read_in_any_order(tmp_path):
    write_json(tmp_path / "plain.json", CONTENT)
    write_json(tmp_path / "sealed.json", with_digest(CONTENT))
    content = json.loads((tmp_path / "sealed.json").read_text())
    write_json(tmp_path / "turned.json", dict(reversed(content.items())))
    plain, read, turned = (
        read_json(tmp_path / f"{name}.json", "thing") for name in ("plain", "sealed", "turned")
    )
    assert repr(read) == repr(plain)  # NaN differs from itself, so texts are compared.
    assert sorted(turned) == sorted(plain)


@pytest.mark.parametrize(
    "change",
    [
        lambda content: content.update(seed=4),
        lambda content: content.update(surplus=1),
        lambda content: content.pop("seed"),
        lambda content: content["b"].update(limit=1.0),
        lambda content: content["a"].reverse(),
        lambda content: content.update(sha256=content["sha256"][:-1]),
        lambda content: content.update(sha256=7),
    ],
)
def test_changed_content_is_refused_until_its_digest_is_deleted(tmp_path, change):
    path, content = tmp_path / "a.json", with_digest(CONTENT)
    change(content)
    write_json(path, content)
    with pytest.raises(
        ValueError,
        match=r"a\.json is not the thing that was written: .* delete the entry sha256 if",
    ):
        read_json(path, "thing")
    del content["sha256"]
    write_json(path, content)
    assert repr(read_json(path, "thing")) == repr(content)


@pytest.mark.parametrize(
    ("content", "error", "words"),
    [
        (b"", ValueError, "{path} is not a run configuration: it is truncated or not JSON"),
        (b'{"a": 1', ValueError, "{path} is not a run configuration: it is truncated or not JSON"),
        (b"not json", ValueError, "{path} is not a run configuration: it is truncated or not JSON"),
        (
            b"\xff\xfe\x00binary",
            ValueError,
            "{path} is not a run configuration: it is truncated or not JSON",
        ),
        (None, FileNotFoundError, "no run configuration at {path}"),
        ("a folder", FileNotFoundError, "no run configuration at {path}"),
    ],
    ids=["empty", "truncated", "text", "binary", "missing", "a folder"],
)
def test_raises_if_a_file_is_not_json(tmp_path, content, error, words):
    path = tmp_path / "damaged.json"
    if content == "a folder":
        path.mkdir()
    elif content is not None:
        path.write_bytes(content)
    with pytest.raises(error, match=words.format(path=path)):
        read_json(path, "run configuration")
