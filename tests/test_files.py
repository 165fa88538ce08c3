"""Files appear whole or not at all."""

import errno
import json
import os
import stat

import pytest

from codrl_mj.runs.files import read_json, sealed, write_json, writing


@pytest.mark.parametrize(
    "error",
    [RuntimeError("broken"), KeyboardInterrupt(), SystemExit(1), OSError(errno.ENOSPC, "No space left on device")],
    ids=lambda error: type(error).__name__,
)
@pytest.mark.parametrize("existing", [None, "old"], ids=["new file", "existing file"])
def test_an_exception_leaves_the_folder_as_it_was(tmp_path, error, existing):
    target = tmp_path / "result.json"
    if existing is not None:
        target.write_text(existing)
    with pytest.raises(type(error)), writing(target) as temporary:  # noqa: PT012 - half of the block must run
        temporary.write_text("half of it")
        raise error
    assert [path.name for path in tmp_path.iterdir()] == ([] if existing is None else ["result.json"])
    if existing is not None:
        assert target.read_text() == existing


def test_a_full_disk_while_writing_json_leaves_nothing(tmp_path, monkeypatch):
    def full(self, text, *_, **__):
        with self.open("w") as file:
            file.write(text[:3])
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("pathlib.Path.write_text", full)
    with pytest.raises(OSError, match="No space left"):
        write_json(tmp_path / "config.json", {"a": 1})
    assert list(tmp_path.iterdir()) == []


def test_a_real_write_error_leaves_nothing(tmp_path):
    with (  # every write to /dev/full fails with ENOSPC
        pytest.raises(OSError, match="No space left"),
        writing(tmp_path / "a.txt"),
        open("/dev/full", "w", buffering=1) as full,  # noqa: PTH123
    ):
        full.write("line\n")
    assert list(tmp_path.iterdir()) == []


def test_failing_to_replace_a_folder_leaves_no_temporary_file(tmp_path):
    (tmp_path / "taken").mkdir()
    with pytest.raises(OSError, match="taken"), writing(tmp_path / "taken") as temporary:
        temporary.write_text("x")
    assert [path.name for path in tmp_path.iterdir()] == ["taken"]


def test_the_target_does_not_exist_before_the_block_ends(tmp_path):
    target = tmp_path / "a.txt"
    with writing(target) as temporary:
        temporary.write_text("whole")
        assert not target.exists()
    assert target.read_text() == "whole"
    assert list(tmp_path.iterdir()) == [target]


def test_an_existing_target_is_replaced(tmp_path):
    target = tmp_path / "a.txt"
    target.write_text("old and longer")
    with writing(target) as temporary:
        temporary.write_text("new")
        assert target.read_text() == "old and longer"
    assert target.read_text() == "new"


@pytest.mark.parametrize(("mask", "mode"), [(0o022, 0o644), (0o077, 0o600), (0o002, 0o664), (0, 0o666)])
def test_permissions_follow_the_umask(tmp_path, mask, mode):
    before = os.umask(mask)
    try:
        with writing(tmp_path / "a.txt") as temporary:
            temporary.write_text("x")
        assert os.umask(mask) == mask  # reading the mask did not change it
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "a.txt").stat().st_mode) == mode


def test_the_temporary_file_is_private_until_it_is_whole(tmp_path):
    with writing(tmp_path / "a.txt") as temporary:
        assert stat.S_IMODE(temporary.stat().st_mode) == 0o600


@pytest.mark.parametrize("name", ["film.mp4", "policy.safetensors", "curve.tar.gz", "nosuffix"])
def test_the_temporary_name_keeps_the_suffix_and_the_folder(tmp_path, name):
    target = tmp_path / name
    with writing(target) as temporary:
        assert temporary.suffix == target.suffix
        assert temporary.parent == target.parent
        assert temporary.name != target.name


def test_missing_folders_are_made(tmp_path):
    write_json(tmp_path / "a" / "b" / "c.json", [1])
    assert (tmp_path / "a" / "b" / "c.json").read_text() == "[\n  1\n]\n"


def test_json_survives_the_round_trip(tmp_path):
    content = {"text": "ω [rad/s]", "list": [1, 2.5, None, True], "nested": {"limit": float("inf")}, "small": 1e-17}
    write_json(tmp_path / "a.json", content)
    assert read_json(tmp_path / "a.json", "thing") == content


CONTENT = {"b": {"limit": float("inf"), 10: (1, 2.5), 9: None}, "a": [float("nan"), "ω"], "seed": 3}


def test_what_is_sealed_is_read_as_it_was_and_its_order_does_not_matter(tmp_path):
    write_json(tmp_path / "plain.json", CONTENT)
    write_json(tmp_path / "sealed.json", sealed(CONTENT))
    content = json.loads((tmp_path / "sealed.json").read_text())
    write_json(tmp_path / "turned.json", dict(reversed(content.items())))
    plain, read, turned = (read_json(tmp_path / f"{name}.json", "thing") for name in ("plain", "sealed", "turned"))
    assert repr(read) == repr(plain)  # NaN is not equal to itself
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
def test_what_is_sealed_and_was_changed_is_refused_until_its_seal_is_deleted(tmp_path, change):
    path, content = tmp_path / "a.json", sealed(CONTENT)
    change(content)
    write_json(path, content)
    with pytest.raises(ValueError, match=r"a\.json is not the thing that was written: .* delete its entry sha256 if"):
        read_json(path, "thing")
    del content["sha256"]
    write_json(path, content)
    assert repr(read_json(path, "thing")) == repr(content)


def test_content_that_is_no_json_leaves_no_file(tmp_path):
    with pytest.raises(TypeError):
        write_json(tmp_path / "a.json", {"a": object()})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "content", [b"", b'{"a": 1', b"not json", b"\xff\xfe\x00binary"], ids=["empty", "truncated", "text", "binary"]
)
def test_reading_damaged_json_names_the_file_and_what_it_should_be(tmp_path, content):
    path = tmp_path / "damaged.json"
    path.write_bytes(content)
    with pytest.raises(ValueError, match="is not a run configuration") as caught:
        read_json(path, "run configuration")
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("make_folder", [False, True], ids=["missing", "a folder"])
def test_reading_a_file_that_is_not_there_names_it(tmp_path, make_folder):
    path = tmp_path / "absent.json"
    if make_folder:
        path.mkdir()
    with pytest.raises(FileNotFoundError, match="no run configuration at") as caught:
        read_json(path, "run configuration")
    assert str(path) in str(caught.value)
