"""Notebooks in examples/ run from top to bottom, are stored with their output, and stay small."""

import json
from pathlib import Path

import pytest

FOLDER = Path(__file__).parent.parent / "examples"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
SHORT = {
    'preset("furuta", "ppo", seed=0)': 'preset("furuta", "ppo", seed=0, total_steps=4096)',
    "40_000": "4096",
}
"""Code that takes a minute -> its short form for the tests."""


def cells_of(path):
    return json.loads(path.read_text())["cells"]


def test_there_are_three_notebooks():
    assert len(NOTEBOOKS) == 3


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_stored_with_its_output_and_small(path):
    code = [cell for cell in cells_of(path) if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in code] == list(range(1, len(code) + 1))
    shown = [output for cell in code for output in cell["outputs"]]
    assert {output["output_type"] for output in shown} <= {"stream", "display_data"}  # no error
    assert any("image/png" in output.get("data", {}) for output in shown)
    assert 10 <= len(cells_of(path)) <= 18
    assert path.stat().st_size < 100_000


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_all_links_of_a_notebook_exist(path):
    text = "".join(
        "".join(cell["source"]) for cell in cells_of(path) if cell["cell_type"] == "markdown"
    )
    links = [part.partition(")")[0] for part in text.split("](")[1:]]
    assert links
    for link in links:
        assert (FOLDER / link.partition("#")[0]).exists(), link


@pytest.mark.matrix
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs(path, tmp_path, monkeypatch):
    """Run with fewer training steps, in a new kernel."""
    nbformat = pytest.importorskip("nbformat")
    client = pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    monkeypatch.setenv("PYTHONPATH", str(FOLDER.parent))
    notebook = nbformat.read(path, 4)
    for cell in notebook.cells:
        for long, short in SHORT.items():
            cell.source = cell.source.replace(long, short)
    client.NotebookClient(
        notebook, timeout=600, resources={"metadata": {"path": str(tmp_path)}}
    ).execute()
