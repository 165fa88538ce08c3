"""Compiled code on disk: recompiled after changes; not used if damaged or not the user's own."""

import importlib
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import mujoco
import numba
import numpy as np
import pytest
from numba.core import event

import codrl_mj
from codrl_mj import compile_cache
from codrl_mj.cli import main

FAMILY = """
import dataclasses
from typing import NamedTuple
import deeper
from codrl_mj.actuators import ActuatorModel
from codrl_mj.fields import real

class State(NamedTuple):
    force: float

@dataclasses.dataclass(frozen=True)
class Spring(ActuatorModel):
    State = State
    share: float = real(0.5, above=0.0)

    @staticmethod
    def advance(parameters, timestep, state, inputs):
        force = deeper.scaled(parameters.share * inputs.desired_torque)
        return State(force), force, ()
"""
HELPER = """
from constants import FACTOR

def inner(value):
    return value * FACTOR

def scaled(value):
    return inner(value) + {added}
"""
STEPS = """
from numba.core import event
import codrl_mj

compiled = event.RecordingListener()
event.register("numba:compile", compiled)
env = codrl_mj.make("InvertedPendulum-v5", "lag")
action = env.action_space.low * 0 + 0.3
observations = [env.reset(seed=3)[0].tolist()]
observations += [env.step(action)[0].tolist() for _ in range(20)]
print(len(compiled.buffer), observations)
"""


@pytest.fixture
def cache_path(tmp_path, monkeypatch):
    """Set an empty cache folder, and return its path."""
    monkeypatch.setenv("CODRL_MJ_CACHE", str(tmp_path / "kept"))
    return tmp_path / "kept"


def run_program(cache, program, *arguments):
    """Run a program in a new process with a cache folder, and return its output."""
    environment = {**os.environ, "CODRL_MJ_CACHE": str(cache)}
    command = [sys.executable, "-c", program, *map(str, arguments)]
    return subprocess.run(
        command, env=environment, capture_output=True, text=True, check=True, timeout=300
    ).stdout


def function(factor):
    """Return a function with a number in its closure; the code is the same for all numbers."""

    @compile_cache.njit(nogil=True)
    def scaled(value):
        return factor * value

    return scaled


def compiled_by(call):
    """Return the number of compilations that a call took, and its result."""
    with event.install_recorder("numba:compile") as recorder:
        value = call()
    return sum(compile_event.is_start for _, compile_event in recorder.buffer), value


@pytest.fixture(scope="module")
def filled_cache(tmp_path_factory):
    """Return a folder that one process filled, and that process's output."""
    cache_folder = tmp_path_factory.mktemp("filled") / "kept"
    count, output = run_program(cache_folder, STEPS).split(" ", 1)
    assert int(count) > 10
    return cache_folder, output


def test_the_next_process_compiles_nothing_and_gives_the_same_results(filled_cache):
    cache_folder, output = filled_cache
    assert run_program(cache_folder, STEPS) == f"0 {output}"


TWINS = """
import math, sys
from codrl_mj import compile_cache
from codrl_mj.engine.memory import internal

def made(factor):
    @internal
    def inner(value):  # too long to be inlined
        total = 0.0
LONG        return factor * value + 0.0 * total

    @compile_cache.njit
    def outer(value):
        return inner(value) + inner(value + 1.0) + inner(value + 2.0)

    return outer

print([made(float(word))(1.0) for word in sys.argv[1:]])
""".replace(
    "LONG", "        total += math.sin(value) + math.cos(total) * math.exp(-total * total)\n" * 40
)


def test_functions_of_one_name_from_two_processes_are_distinguished(cache_path):
    """Check functions that are the first of their processes, so that a count would be equal."""
    # Both processes run at the same time.
    with ThreadPoolExecutor(2) as pool:
        pool.map(lambda factor: run_program(cache_path, TWINS, factor), (2.0, 5.0))
    assert len([*cache_path.iterdir()]) == 2
    assert run_program(cache_path, TWINS, 5.0, 3.0, 2.0).strip() == "[30.0, 18.0, 12.0]"


@pytest.mark.parametrize(
    ("length", "suffix"), [(-1, b""), (0, b""), (32, b"x" * 500), (0, bytes(range(200)))]
)
def test_damaged_files_are_replaced(cache_path, length, suffix):
    function(6.0)(1.0)
    (file,) = cache_path.iterdir()
    file.write_bytes(file.read_bytes()[:length] + suffix)
    assert compiled_by(lambda: function(6.0)(1.0)) == (1, 6.0)
    # The file must have been written again.
    assert [*cache_path.iterdir()] == [file]
    assert compiled_by(lambda: function(6.0)(1.0)) == (0, 6.0)


def test_concurrent_writers_leave_complete_files(cache_path):
    """Check that a concurrent reader gets the complete file of one of the writers."""
    contents = [bytes([number]) * size for number, size in enumerate((3_000_000, 1_000_000))]
    compile_cache._write(cache_path / "one.code", contents[0])
    with ThreadPoolExecutor(3) as pool:
        for content in contents:
            pool.submit(
                lambda content=content: [
                    compile_cache._write(cache_path / "one.code", content) for _ in range(30)
                ]
            )
        contents_read = [
            *pool.map(lambda _: compile_cache._read(cache_path / "one.code"), range(60))
        ]
    assert set(contents_read) <= set(contents)
    assert [path.name for path in cache_path.iterdir()] == ["one.code"]


def test_a_change_in_indirectly_imported_modules_recompiles(filled_cache, tmp_path, monkeypatch):
    """Change a constant in a helper of a helper, then the code of a helper, and go back."""
    monkeypatch.setenv("CODRL_MJ_CACHE", str(filled_cache[0]))
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    (tmp_path / "own.py").write_text(FAMILY)

    def observations(factor, added):
        """Return observations as a new process would compute them."""
        (tmp_path / "deeper.py").write_text(HELPER.format(added=added))
        (tmp_path / "constants.py").write_text(f"FACTOR = {factor}\n")
        compile_cache._source_of.cache_clear()
        env = codrl_mj.make("InvertedPendulum-v5", importlib.import_module("own").Spring())
        for name in ("own", "deeper", "constants"):
            del sys.modules[name]
        env.reset(seed=3)
        return [env.step(env.action_space.low * 0 + 0.3)[0].tolist() for _ in range(5)]

    first = observations(1.0, 0.0)
    assert compiled_by(lambda: observations(1.0, 0.0)) == (0, first)
    for factor, added in ((2.0, 0.0), (1.0, 0.25)):
        count, other_observations = compiled_by(
            lambda factor=factor, added=added: observations(factor, added)
        )
        assert count > 0
        assert other_observations != first
    assert compiled_by(lambda: observations(1.0, 0.0)) == (0, first)


def test_nothing_is_stored_if_the_folder_cannot_be_made(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("CODRL_MJ_CACHE", str(tmp_path / "file" / "inside"))
    assert compiled_by(lambda: function(5.0)(1.0)) == (1, 5.0)


def divided(divisor):
    return 1.0 / divisor


def entry_of(table):
    @compile_cache.njit
    def first(entry):
        return table[entry]

    return first


@pytest.mark.parametrize(
    ("first", "second"),
    [
        # Values in the closure.
        (
            (lambda: function(2.0)(3.0), 6.0),
            (lambda: function(4.0)(3.0), 12.0),
        ),
        # Types of the arguments.
        ((lambda: function(2.0)(3.0), 6.0), (lambda: function(2.0)(3), 6.0)),
        # Options of the compiler.
        (
            (lambda: compile_cache.njit(divided, error_model="numpy")(2.0), 0.5),
            (lambda: compile_cache.njit(divided)(2.0), 0.5),
        ),
        # Contents of arrays.
        (
            (lambda: entry_of(np.arange(3.0))(1), 1.0),
            (lambda: entry_of(np.arange(3.0) + 1.0)(1), 2.0),
        ),
    ],
)
def test_equal_functions_are_compiled_once_and_different_ones_separately(cache_path, first, second):
    for compilations, (call, value) in (
        (1, first),
        (0, first),
        (1, second),
        (0, first),
        (0, second),
    ):
        assert compiled_by(call) == (compilations, value)


def test_functions_with_unhashable_values_are_not_stored(cache_path):
    @compile_cache.njit
    def reading(entry):
        return entry + len(unknown_type)

    # A class whose code the cache does not know.
    unknown_type = (1.0, object)
    with pytest.raises(numba.core.errors.TypingError):
        reading(1)
    assert not cache_path.exists()


@pytest.mark.parametrize("mode", [0o777, 0o770, 0o722])
def test_folders_and_files_that_others_can_write_are_not_used(cache_path, mode):
    cache_path.mkdir()
    cache_path.chmod(mode)
    assert compiled_by(lambda: function(7.0)(1.0)) == (1, 7.0)
    assert not [*cache_path.iterdir()]
    cache_path.chmod(0o700)
    assert compiled_by(lambda: function(7.0)(1.0)) == (1, 7.0)
    (file,) = cache_path.iterdir()
    file.chmod(0o666)
    assert compiled_by(lambda: function(7.0)(1.0)) == (1, 7.0)


ANOTHER = type("Other", (str,), {"flatten": str})("another")


@pytest.mark.parametrize(
    "change",
    [
        *(
            lambda patch, library=library: patch.setattr(library, "__version__", "another")
            for library in (numba, np, compile_cache.llvmlite, mujoco)
        ),
        lambda patch: patch.setattr(compile_cache.binding, "get_host_cpu_name", lambda: ANOTHER),
        lambda patch: patch.setattr(
            compile_cache.binding, "get_host_cpu_features", lambda: ANOTHER
        ),
        lambda patch: patch.setattr(numba.config, "CPU_NAME", "generic"),
        lambda patch: patch.setattr(numba.config, "OPT", 1),
        lambda _: (compile_cache._PACKAGE / "a.py").write_text("x = 2"),
    ],
)
def test_versions_cpu_settings_and_this_packages_source_are_in_the_key(
    cache_path, tmp_path, monkeypatch, change
):
    monkeypatch.setattr(compile_cache, "_PACKAGE", tmp_path)
    (tmp_path / "a.py").write_text("x = 1")
    compile_cache._base_key.cache_clear()
    before = compile_cache._path("name", ())
    change(monkeypatch)
    compile_cache._base_key.cache_clear()
    assert compile_cache._path("name", ()) != before
    monkeypatch.undo()
    compile_cache._base_key.cache_clear()


def test_the_location_of_numba_is_not_in_the_key(cache_path, monkeypatch):
    before = compile_cache._path("name", ())
    monkeypatch.setattr(numba.config, "__file__", "/elsewhere/numba/core/config.py")
    compile_cache._base_key.cache_clear()
    assert compile_cache._path("name", ()) == before
    compile_cache._base_key.cache_clear()


def test_the_least_recently_used_file_is_deleted(cache_path, monkeypatch):
    function(1.5)(1.0)
    (old,) = cache_path.iterdir()
    os.utime(old, (1.0, 1.0))
    monkeypatch.setattr(compile_cache, "MAX_BYTES", old.stat().st_size + 100)
    function(2.5)(1.0)
    (new,) = cache_path.iterdir()
    assert new != old


def test_a_second_address_under_a_symbol_gets_a_new_name(monkeypatch):
    monkeypatch.setattr(compile_cache, "_SYMBOLS", {})
    numbers = np.arange(4)
    first, second = (
        compile_cache.register_symbol("codrl_mj_test", numbers[offset:].ctypes.data)
        for offset in (0, 2)
    )
    assert first != second
    assert compile_cache.register_symbol("codrl_mj_test", numbers.ctypes.data) == first


def test_the_command_line_shows_and_clears_the_cache(cache_path, monkeypatch, capsys):
    def command_output(*flags):
        assert main(["cache", *flags]) == 0
        return capsys.readouterr().out

    assert "empty" in command_output()
    function(3.5)(1.0)
    output = command_output()
    assert str(cache_path) in output
    assert "1 file" in output
    command_output("--clear")
    assert not [*cache_path.iterdir()]
    monkeypatch.setenv("CODRL_MJ_CACHE", "off")
    assert compile_cache.cache_folder() is None
    assert "off" in command_output()
