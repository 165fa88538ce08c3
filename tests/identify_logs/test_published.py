"""What others have published is fetched as it is, from a server of the test's own; nothing else passes for it."""

import functools
import hashlib
import http.server
import threading

import pytest

from codrl_mj.cli import main
from codrl_mj.identify import published as module
from codrl_mj.identify.published import fetch, published
from tests.published import published_folder

LOG = b"time,position\n0,0\n"


@pytest.fixture
def served(tmp_path, monkeypatch):
    """A set of one file on a server of this machine."""
    there = tmp_path / "there" / "abc" / "results"
    there.mkdir(parents=True)
    (there / "measured.csv").write_bytes(LOG)
    handler = functools.partial(http.server.SimpleHTTPRequestHandler, directory=tmp_path / "there")
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    about = {
        "title": "a rig",
        "source": f"http://127.0.0.1:{server.server_port}",
        "commit": "abc",
        "licence": "MIT",
        "columns": "time=time:s",
        "files": {
            "ours.csv": {"path": "results/measured.csv", "sha256": hashlib.sha256(LOG).hexdigest()}
        },
    }
    monkeypatch.setattr(module, "published", lambda: {"rig": about})
    yield there / "measured.csv"
    server.shutdown()
    server.server_close()


def test_a_set_is_fetched_once(served, tmp_path, capsys):
    assert main(["data", "rig", "--out", str(tmp_path / "data")]) == 0
    file = tmp_path / "data" / "bench_logs" / "rig" / "ours.csv"
    assert file.read_bytes() == LOG
    told = capsys.readouterr().out
    assert [text for text in (str(file), "MIT", "time=time:s") if text not in told] == []
    served.unlink()
    assert fetch("rig", tmp_path / "data") == [file]


def test_a_file_that_was_changed_since_or_cannot_be_had_is_refused(served, tmp_path, capsys):
    served.write_bytes(b"something else")
    for said in ("is not the file that was published", "results/measured.csv: cannot be had"):
        assert main(["data", "rig", "--out", str(tmp_path / "data")]) == 2
        assert said in capsys.readouterr().err
        assert not (tmp_path / "data" / "bench_logs" / "rig" / "ours.csv").exists()
        served.unlink(missing_ok=True)


def test_what_there_is_is_listed_and_an_unknown_name_is_not_looked_for(capsys):
    assert main(["data"]) == 0
    listed = capsys.readouterr().out
    for name, about in published().items():
        assert name in listed
        assert about["licence"] in listed
    assert main(["data", "dfki"]) == 2
    assert "did you mean 'dfki_pendulum'" in capsys.readouterr().err


@pytest.mark.parametrize("name", published())
def test_the_digests_are_those_of_the_files(name):
    folder = published_folder(name)
    for file, about in published()[name]["files"].items():
        assert hashlib.sha256((folder / file).read_bytes()).hexdigest() == about["sha256"], file
