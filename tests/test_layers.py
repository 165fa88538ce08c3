"""Imports between layers, read from the source, so that a cycle or a shortcut fails here."""

import ast
import functools
import re
import sys
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parent.parent / "codrl_mj"

ALLOWED = {
    # Layer (a package, a top-level module, or a module in a lower layer than its package) -> layers
    # that it may import.
    "boundary": set(),
    "fields": set(),
    "user_code": {"fields"},
    "actuators": {"catalogue", "fields", "user_code"},
    "arrays": {"actuators", "fields", "user_code"},
    "arrays.models": {"actuators", "engine", "fields"},
    "arrays.warp": {"actuators", "arrays", "fields"},
    "arrays.written_models": {"actuators"},
    "arrays.written_losses": {"actuators", "arrays", "arrays.written_models"},
    "arrays.writers": {"actuators", "arrays", "arrays.written_losses", "arrays.written_models"},
    "arrays.warp_inertia": set(),
    "arrays.draws": {
        *("actuators", "arrays.models", "engine", "fields"),
        *("envs.distributions", "envs.motor_fields"),
    },
    "arrays.mujoco_warp": {
        *("actuators", "arrays", "arrays.models", "arrays.draws", "arrays.warp"),
        *("arrays.warp_inertia", "fields"),
    },
    "arrays.mjx": {
        *("actuators", "arrays", "arrays.models", "arrays.draws"),
        *("envs.motor_fields", "fields"),
    },
    "arrays.mjlab": {"actuators", "arrays", "arrays.warp", "arrays.warp_inertia", "engine"},
    "disturbances": {"actuators", "fields"},
    "tasks": {"actuators", "fields", "user_code"},
    "catalogue": {"fields", "user_code"},
    "plugin": set(),
    "requirements": set(),
    "__init__": {"plugin", "requirements"},
    "compile_cache": set(),
    "engine": {"actuators", "fields", "compile_cache", "user_code", "plugin"},
    "physics": {
        "actuators",
        "disturbances",
        "engine",
        "fields",
        "compile_cache",
        "user_code",
        "tasks",
    },
    "envs.distributions": {"fields"},
    "envs.patterns": {"actuators"},
    "envs.motor_fields": {"actuators", "envs.distributions"},
    "envs.config": {
        "actuators",
        "disturbances",
        "envs.distributions",
        "fields",
        "tasks",
        "user_code",
    },
    "envs": {
        *(
            "actuators",
            "disturbances",
            "engine",
            "envs.config",
            "envs.distributions",
            "envs.motor_fields",
            "envs.patterns",
            "fields",
        ),
        *("compile_cache", "user_code", "physics", "tasks"),
    },
    "external_envs": {
        *(
            "actuators",
            "disturbances",
            "engine",
            "envs",
            "envs.config",
            "envs.distributions",
            "fields",
            "physics",
        ),
        *("envs.patterns", "user_code", "tasks"),
    },
    "factory": {"envs.config"},
    "suite": {"actuators", "envs", "envs.config", "external_envs", "physics", "tasks"},
    "agents": {
        "actuators",
        "envs",
        "envs.config",
        "fields",
        "compile_cache",
        "user_code",
        "physics",
    },
    "runs": set(),
    "runs.files": set(),
    "runs.summaries": {"actuators", "envs.patterns", "fields", "runs.files", "runs", "tasks"},
    "runs.policies": {"actuators", "agents", "envs.config", "runs.files", "runs"},
    "evaluation.measures": set(),
    "evaluation": {
        *(
            "actuators",
            "envs",
            "envs.config",
            "evaluation.measures",
            "fields",
            "physics",
            "runs.files",
        ),
        *("runs.policies", "tasks"),
    },
    "deploy": {
        *("actuators", "agents", "engine", "envs", "envs.config", "evaluation", "fields"),
        "compile_cache",
        *("runs.files", "runs.policies", "tasks", "user_code"),
    },
    "viz": set(),
    "viz.scene": {"envs", "envs.config", "physics", "user_code"},
    "viz.films": {
        "viz.scene",
        "actuators",
        "envs",
        "envs.config",
        "evaluation",
        "physics",
        "runs.files",
        "runs.policies",
        "tasks",
    },
    "viz.replay": {"envs.config", "evaluation", "runs.files", "viz.scene"},
    "viz.view": {
        *("actuators", "envs.config", "evaluation", "fields", "runs.policies", "viz.replay"),
    },
    "training": {
        *(
            "actuators",
            "agents",
            "disturbances",
            "envs",
            "envs.config",
            "evaluation",
            "runs.files",
            "runs",
        ),
        *("runs.policies", "tasks", "user_code", "fields", "external_envs", "plots"),
    },
    "sizing": {
        *(
            "actuators",
            "catalogue",
            "engine",
            "envs.config",
            "evaluation",
            "fields",
            "external_envs",
        ),
        *("runs.policies", "tasks", "training"),
    },
    "plots": {"runs.files"},
    "validation": {
        "actuators",
        "catalogue",
        "engine",
        "plots",
        "physics",
        "runs.files",
        "tasks",
        "user_code",
    },
    "study": {
        *(
            "actuators",
            "disturbances",
            "envs.config",
            "evaluation",
            "evaluation.measures",
            "fields",
            "viz.films",
        ),
        *("sizing", "engine", "runs", "runs.files", "runs.policies", "tasks", "training"),
    },
    "rl_zoo3": set(),
    "identify": {
        "actuators",
        "catalogue",
        "fields",
        "compile_cache",
        "disturbances",
        "runs.files",
        "user_code",
    },
    "viz.pages": {
        *(
            "__init__",
            "actuators",
            "catalogue",
            "sizing",
            "evaluation",
            "viz.films",
            "external_envs",
            "identify",
            "envs.config",
        ),
        *(
            "plots",
            "viz.replay",
            "viz.scene",
            "runs.files",
            "runs",
            "runs.policies",
            "runs.summaries",
            "tasks",
            "training",
        ),
        "validation",
    },
    "cli": {
        *(
            "actuators",
            "agents",
            "arrays",
            "arrays.written_losses",
            "catalogue",
            "disturbances",
            "envs.config",
            "evaluation",
        ),
        *("deploy", "evaluation.measures", "fields", "viz.films", "compile_cache", "user_code"),
        *(
            "external_envs",
            "identify",
            "user_code",
            "viz.pages",
            "plots",
            "viz.replay",
            "runs.files",
            "runs",
            "runs.policies",
            "runs.summaries",
            "sizing",
            "engine",
            "study",
            "tasks",
            "training",
            "validation",
            "viz.view",
        ),
        "requirements",
    },
    "__main__": {"cli", "requirements"},
}
LIBRARIES = {
    # Package or module -> libraries that it may import besides the standard library.
    "fields": set(),
    "user_code": {"numpy", "yaml"},
    "actuators": {"numpy"},
    "arrays": {"numpy"},
    "arrays.models": {"mujoco", "numpy"},
    "arrays.warp": {"numpy", "warp"},
    "arrays.written_models": {"numpy"},
    "arrays.written_losses": {"mujoco", "numpy"},
    "arrays.writers": set(),
    "arrays.warp_inertia": {"warp"},
    "arrays.draws": {"mujoco", "numpy"},
    "arrays.mujoco_warp": {"mujoco", "numpy"},
    "arrays.mjx": {"jax", "mujoco", "numpy"},
    "arrays.mjlab": {"mjlab", "mujoco", "numpy", "torch", "warp"},
    "disturbances": {"numpy"},
    "tasks": {"numpy", "gymnasium", "mujoco"},
    "catalogue": {"pint"},
    "identify": {"numba", "numpy", "pooch", "scipy", "yaml"},
    "plots": {"matplotlib", "numpy"},
    "viz.pages": {"jinja2", "markupsafe", "matplotlib", "numpy", "scipy"},
    "plugin": {"mujoco"},
    "requirements": set(),
    "compile_cache": {"mujoco", "numba", "llvmlite", "numpy", "platformdirs"},
    "engine": {"mujoco", "numba", "llvmlite", "numpy"},
    "physics": {"mujoco", "numba", "numpy", "gymnasium", "pygame"},
    "external_envs": {"dm_control", "dm_env", "gymnasium", "mujoco", "numpy"},
    "envs.distributions": {"numpy"},
    "envs.motor_fields": set(),
    "envs.config": {"gymnasium", "numpy"},
    "envs": {"gymnasium", "numpy", "numba", "mujoco", "stable_baselines3"},
    "evaluation.measures": {"numpy", "scipy"},
    "viz.replay": {"mujoco", "numpy"},
    "viz.view": {"gymnasium", "mujoco", "numpy", "trimesh", "viser", "websockets"},
    "runs.files": set(),
    "runs.summaries": set(),
}
GYMNASIUM_IN_TASKS = {
    "gymnasium.spaces",
    "gymnasium.envs.classic_control.utils",
    "gymnasium.envs.registration",
}


def _layer(module):
    """Return the layer of a module such as `envs.config`: the longest matching prefix."""
    parts = module.split(".")
    known = (".".join(parts[:length]) for length in range(len(parts), 0, -1))
    return next((name for name in known if name in ALLOWED), module)


def _module(path):
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(parts[:-1] if len(parts) > 1 and parts[-1] == "__init__" else parts)


def _files(layer):
    return [path for path in EVERY_FILE if _layer(_module(path)) == layer]


@functools.cache
def _modules(path):
    """Return every module that a file imports, with `from a import b` as both a and a.b."""
    modules = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            modules |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            modules |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return modules


@functools.cache
def _imported_layers(path):
    """Return the layers that a file imports; names that are no module are attributes of one."""
    names = {
        name.removeprefix("codrl_mj.") for name in _modules(path) if name.startswith("codrl_mj.")
    }
    return {_layer(name) for name in names if _is_module(name)}


def _is_module(name):
    path = PACKAGE.joinpath(*name.split("."))
    return path.is_dir() or path.with_suffix(".py").is_file()


EVERY_FILE = sorted(PACKAGE.rglob("*.py"))


def test_the_reader_finds_known_imports():
    """Check the oracle itself."""
    assert {"actuators", "engine", "tasks"} <= set().union(
        *map(_imported_layers, _files("physics"))
    )
    assert "mujoco" in _modules(PACKAGE / "engine" / "control.py")
    assert len(EVERY_FILE) > 20


@pytest.mark.parametrize("layer", ALLOWED)
def test_a_layer_imports_only_the_layers_below_it(layer):
    for path in _files(layer):
        assert _imported_layers(path) - {layer, "boundary"} <= ALLOWED[layer], path


def test_every_file_belongs_to_a_layer():
    assert {_layer(_module(path)) for path in EVERY_FILE} == ALLOWED.keys()


def test_no_layers_import_each_other_in_a_circle():
    graph = {}
    for path in EVERY_FILE:
        layer = _layer(_module(path))
        graph.setdefault(layer, set()).update(_imported_layers(path) - {layer})
    assert set(TopologicalSorter(graph).static_order()) >= ALLOWED.keys()  # raises CycleError


@pytest.mark.parametrize("layer", LIBRARIES)
def test_a_layer_imports_only_its_own_libraries(layer):
    for path in _files(layer):
        roots = (
            {name.split(".")[0] for name in _modules(path)}
            - {"codrl_mj"}
            - set(sys.stdlib_module_names)
        )
        assert roots <= LIBRARIES[layer], path


def test_tasks_import_from_gymnasium_only_spaces_reset_bounds_and_registry():
    for path in _files("tasks"):
        names = {
            name for name in _modules(path) if name.startswith("gymnasium.")
        }  # twins make environments
        packages = {
            name
            for allowed_name in GYMNASIUM_IN_TASKS
            for name in (allowed_name.rpartition(".")[0],)
        }
        assert all(
            name in packages or any(name.startswith(allowed) for allowed in GYMNASIUM_IN_TASKS)
            for name in names
        ), path


def test_nothing_imports_the_command_line():
    for path in EVERY_FILE:
        if path.relative_to(PACKAGE).parts[0] not in ("cli", "__main__.py"):
            assert "cli" not in _imported_layers(path), path


def test_nothing_hides_an_import_behind_type_checking():
    for path in EVERY_FILE:
        assert "TYPE_CHECKING" not in path.read_text(), path


def test_only_the_module_fields_suggests_names():
    assert [path for path in EVERY_FILE if "difflib" in path.read_text()] == [PACKAGE / "fields.py"]


def test_only_the_engine_accesses_raw_memory():
    for path in EVERY_FILE:
        if "engine" not in path.parts and path.name != "compile_cache.py":
            assert not re.search(r"\._address\b", path.read_text()), path  # of mjModel and mjData
            assert "llvmlite" not in path.read_text(), path


def test_only_the_engine_knows_which_backend_drives_an_actuator():
    for path in EVERY_FILE:
        if "engine" not in path.parts:
            assert "actuator_plugin" not in path.read_text(), path


def test_nothing_that_computes_imports_what_shows():
    shows = ("viz", "cli", "__main__", "study")
    for path in EVERY_FILE:
        if not _module(path).startswith(shows):
            viz = {layer for layer in _imported_layers(path) if layer.startswith("viz")}
            assert not viz, path
