"""Who imports whom: read from the source, so that a cycle or a shortcut fails here."""

import ast
import re
import sys
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parent.parent / "codrl_mj"

ALLOWED = {
    # layer: the layers of ours that it may import
    "registration": set(),
    "assets": set(),
    "motor": set(),
    "files": set(),
    "measures": set(),
    "runs": {"files", "motor"},
    "disturbances": {"motor"},
    "distributions": set(),
    "tasks": set(),
    "callbacks": {"motor"},
    "physics": {"assets", "motor", "disturbances", "callbacks", "tasks"},
    "envs": {"tasks", "physics", "motor", "disturbances", "distributions", "registration"},
}
FOREIGN = {
    # layer: what it may import besides the standard library
    "motor": {"numpy"},
    "measures": {"numpy", "scipy"},
    "runs": set(),
    "disturbances": {"numpy"},
    "distributions": {"numpy"},
    "assets": set(),
    "registration": {"gymnasium"},
    "tasks": {"numpy", "numba", "gymnasium"},
    "callbacks": {"mujoco", "numba", "llvmlite", "numpy"},
    "physics": {"mujoco", "numba", "numpy", "gymnasium"},
    "envs": {"gymnasium", "numpy", "numba", "mujoco", "stable_baselines3"},
}
GYMNASIUM_IN_TASKS = {"gymnasium.spaces", "gymnasium.envs.classic_control.utils"}


def _files(layer):
    folder = PACKAGE / layer
    return sorted(folder.rglob("*.py")) if folder.is_dir() else [PACKAGE / f"{layer}.py"]


def _modules(path):
    """Every module that a file imports anywhere, with `from a import b` as both a and a.b."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def _ours(path):
    """Our layers that a file imports; names that are no module or package of ours are attributes of it."""
    layers = {name.split(".")[1] for name in _modules(path) if name.startswith("codrl_mj.")}
    return {layer for layer in layers if (PACKAGE / layer).is_dir() or (PACKAGE / f"{layer}.py").is_file()}


EVERY_FILE = sorted(PACKAGE.rglob("*.py"))


def test_the_reader_sees_what_is_there():
    """The oracle itself: known imports are found."""
    assert {"motor", "callbacks", "assets", "tasks"} <= set().union(*map(_ours, _files("physics")))
    assert "mujoco" in set(_modules(PACKAGE / "callbacks" / "kernels.py"))
    assert len(EVERY_FILE) > 20


@pytest.mark.parametrize("layer", ALLOWED)
def test_a_layer_imports_only_the_layers_below_it(layer):
    for path in _files(layer):
        assert _ours(path) - {layer} <= ALLOWED[layer], path


def test_no_layers_import_each_other_in_a_circle():
    graph = {}
    for path in EVERY_FILE:
        layer = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
        graph.setdefault(layer, set()).update(_ours(path) - {layer})
    assert set(TopologicalSorter(graph).static_order()) >= ALLOWED.keys()  # raises CycleError


@pytest.mark.parametrize("layer", FOREIGN)
def test_a_layer_imports_only_its_own_libraries(layer):
    for path in _files(layer):
        roots = {name.split(".")[0] for name in _modules(path)} - {"codrl_mj"} - set(sys.stdlib_module_names)
        assert roots <= FOREIGN[layer], path


def test_tasks_take_from_gymnasium_only_its_spaces_and_its_reset_bounds():
    for path in _files("tasks"):
        names = {name for name in _modules(path) if name.startswith("gymnasium")}
        packages = {name for other in GYMNASIUM_IN_TASKS for name in (other.rpartition(".")[0],)}
        assert all(name in packages or any(name.startswith(good) for good in GYMNASIUM_IN_TASKS) for name in names), (
            path
        )


def test_nothing_imports_the_command_line():
    for path in EVERY_FILE:
        if path.relative_to(PACKAGE).parts[0] != "cli":
            assert "cli" not in _ours(path), path


def test_nothing_hides_an_import_behind_type_checking():
    for path in EVERY_FILE:
        assert "TYPE_CHECKING" not in path.read_text(), path


def test_only_callbacks_touch_raw_memory():
    for path in EVERY_FILE:
        if "callbacks" not in path.parts:
            assert not re.search(r"\._address\b", path.read_text()), path  # of mjModel and mjData
            assert "llvmlite" not in path.read_text(), path
