"""Downloads of published data sets from a local server, and their verification by digests."""

import functools
import hashlib
import http.server
import threading

import pytest

from codrl_mj.cli import main
from codrl_mj.identify import published as module
from codrl_mj.identify.published import fetch, published_datasets
from tests.published import published_folder

LOG = b"time,position\n0,0\n"


@pytest.fixture
def served_file(tmp_path, monkeypatch):
    """Serve a data set of one file, and yield the path of the served file."""
    folder = tmp_path / "served" / "abc" / "results"
    folder.mkdir(parents=True)
    (folder / "measured.csv").write_bytes(LOG)
    handler = functools.partial(http.server.SimpleHTTPRequestHandler, directory=tmp_path / "served")
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    dataset = {
        "title": "a rig",
        "source": f"http://127.0.0.1:{server.server_port}",
        "commit": "abc",
        "licence": "MIT",
        "columns": "time=time:s",
        "files": {
            "ours.csv": {"path": "results/measured.csv", "sha256": hashlib.sha256(LOG).hexdigest()}
        },
    }
    monkeypatch.setattr(module, "published_datasets", lambda: {"rig": dataset})
    yield folder / "measured.csv"
    server.shutdown()
    server.server_close()


def test_a_data_set_is_downloaded_once(served_file, tmp_path, capsys):
    assert main(["data", "rig", "--out", str(tmp_path / "data")]) == 0
    file = tmp_path / "data" / "bench_logs" / "rig" / "ours.csv"
    assert file.read_bytes() == LOG
    output = capsys.readouterr().out
    assert [text for text in (str(file), "MIT", "time=time:s") if text not in output] == []
    served_file.unlink()
    assert fetch("rig", tmp_path / "data") == [file]


def test_raises_if_a_file_differs_or_cannot_be_downloaded(served_file, tmp_path, capsys):
    served_file.write_bytes(b"something else")
    for message in (
        "differs from the published file",
        "results/measured.csv: cannot be downloaded",
    ):
        assert main(["data", "rig", "--out", str(tmp_path / "data")]) == 2
        assert message in capsys.readouterr().err
        assert not (tmp_path / "data" / "bench_logs" / "rig" / "ours.csv").exists()
        served_file.unlink(missing_ok=True)


def test_data_sets_are_listed_and_an_unknown_name_raises_an_error(capsys):
    assert main(["data"]) == 0
    output = capsys.readouterr().out
    for name, dataset in published_datasets().items():
        assert name in output
        assert dataset["licence"] in output
    assert main(["data", "dfki"]) == 2
    assert "did you mean 'dfki_pendulum'" in capsys.readouterr().err


@pytest.mark.parametrize("name", published_datasets())
def test_the_digests_match_the_files(name):
    folder = published_folder(name)
    for file, entry in published_datasets()[name]["files"].items():
        assert hashlib.sha256((folder / file).read_bytes()).hexdigest() == entry["sha256"], file
