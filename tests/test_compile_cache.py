"""Compiled code that is kept on disk: what was changed is compiled anew, what is damaged or not ours is not used."""

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
seen = [env.reset(seed=3)[0].tolist()] + [env.step(env.action_space.low * 0 + 0.3)[0].tolist() for _ in range(20)]
print(len(compiled.buffer), seen)
"""


@pytest.fixture
def place(tmp_path, monkeypatch):
    """An empty folder to keep code in."""
    monkeypatch.setenv("CODRL_MJ_CACHE", str(tmp_path / "kept"))
    return tmp_path / "kept"


def printed(cache, program, *words):
    """What a new process prints that keeps its code in a folder."""
    environment = {**os.environ, "CODRL_MJ_CACHE": str(cache)}
    command = [sys.executable, "-c", program, *map(str, words)]
    return subprocess.run(
        command, env=environment, capture_output=True, text=True, check=True, timeout=300
    ).stdout


def function(factor):
    """A function that closes over a number; its own code is the same for every one."""

    @compile_cache.njit(nogil=True)
    def scaled(value):
        return factor * value

    return scaled


def compiled_by(call):
    """How many compilations a call took, and what it returned."""
    with event.install_recorder("numba:compile") as recorder:
        value = call()
    return sum(happened.is_start for _, happened in recorder.buffer), value


@pytest.fixture(scope="module")
def filled(tmp_path_factory):
    """A folder that one process filled, and what that process saw."""
    folder = tmp_path_factory.mktemp("filled") / "kept"
    count, seen = printed(folder, STEPS).split(" ", 1)
    assert int(count) > 10
    return folder, seen


def test_the_next_process_compiles_nothing_and_sees_the_same(filled):
    folder, seen = filled
    assert printed(folder, STEPS) == f"0 {seen}"


TWINS = """
import math, sys
from codrl_mj import compile_cache
from codrl_mj.engine.memory import internal

def made(factor):
    @internal
    def inner(value):  # too long to be inlined
        total = 0.0
LONG        return factor * value + 0.0 * total

    @kept.njit
    def outer(value):
        return inner(value) + inner(value + 1.0) + inner(value + 2.0)

    return outer

print([made(float(word))(1.0) for word in sys.argv[1:]])
""".replace(
    "LONG", "        total += math.sin(value) + math.cos(total) * math.exp(-total * total)\n" * 40
)


def test_functions_of_one_name_that_two_processes_compiled_stay_apart(place):
    """Each is the first of its process, so that a count would call them alike."""
    with ThreadPoolExecutor(2) as both:  # at once
        both.map(lambda factor: printed(place, TWINS, factor), (2.0, 5.0))
    assert len([*place.iterdir()]) == 2
    assert printed(place, TWINS, 5.0, 3.0, 2.0).strip() == "[30.0, 18.0, 12.0]"


@pytest.mark.parametrize(
    ("length", "more"), [(-1, b""), (0, b""), (32, b"x" * 500), (0, bytes(range(200)))]
)
def test_what_is_damaged_is_compiled_anew(place, length, more):
    function(6.0)(1.0)
    (file,) = place.iterdir()
    file.write_bytes(file.read_bytes()[:length] + more)
    assert compiled_by(lambda: function(6.0)(1.0)) == (1, 6.0)
    assert [*place.iterdir()] == [file]  # written anew
    assert compiled_by(lambda: function(6.0)(1.0)) == (0, 6.0)


def test_two_that_write_at_once_leave_whole_files(place):
    """Whoever reads meanwhile gets what one of them wrote."""
    contents = [bytes([number]) * size for number, size in enumerate((3_000_000, 1_000_000))]
    compile_cache._write(place / "one.code", contents[0])
    with ThreadPoolExecutor(3) as pool:
        for content in contents:
            pool.submit(
                lambda content=content: [
                    compile_cache._write(place / "one.code", content) for _ in range(30)
                ]
            )
        found = [*pool.map(lambda _: compile_cache._read(place / "one.code"), range(60))]
    assert set(found) <= set(contents)
    assert [path.name for path in place.iterdir()] == ["one.code"]


def test_a_change_deep_in_somebodys_own_modules_is_seen(filled, tmp_path, monkeypatch):
    """A constant in a helper of a helper: of the value alone, of the code alone, and back."""
    monkeypatch.setenv("CODRL_MJ_CACHE", str(filled[0]))
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    (tmp_path / "own.py").write_text(FAMILY)

    def seen(factor, added):
        """As in a new process."""
        (tmp_path / "deeper.py").write_text(HELPER.format(added=added))
        (tmp_path / "constants.py").write_text(f"FACTOR = {factor}\n")
        compile_cache._file.cache_clear()
        env = codrl_mj.make("InvertedPendulum-v5", importlib.import_module("own").Spring())
        for name in ("own", "deeper", "constants"):
            del sys.modules[name]
        env.reset(seed=3)
        return [env.step(env.action_space.low * 0 + 0.3)[0].tolist() for _ in range(5)]

    first = seen(1.0, 0.0)
    assert compiled_by(lambda: seen(1.0, 0.0)) == (0, first)
    for factor, added in ((2.0, 0.0), (1.0, 0.25)):
        count, other = compiled_by(lambda factor=factor, added=added: seen(factor, added))
        assert count > 0
        assert other != first
    assert compiled_by(lambda: seen(1.0, 0.0)) == (0, first)


def test_where_no_folder_can_be_nothing_is_kept(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("CODRL_MJ_CACHE", str(tmp_path / "file" / "inside"))
    assert compiled_by(lambda: function(5.0)(1.0)) == (1, 5.0)


def divided(by):
    return 1.0 / by


def entry_of(table):
    @compile_cache.njit
    def first(entry):
        return table[entry]

    return first


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (
            (lambda: function(2.0)(3.0), 6.0),
            (lambda: function(4.0)(3.0), 12.0),
        ),  # what it closes over
        ((lambda: function(2.0)(3.0), 6.0), (lambda: function(2.0)(3), 6.0)),  # types
        (
            (lambda: compile_cache.njit(divided, error_model="numpy")(2.0), 0.5),
            (lambda: compile_cache.njit(divided)(2.0), 0.5),
        ),  # options
        (
            (lambda: entry_of(np.arange(3.0))(1), 1.0),
            (lambda: entry_of(np.arange(3.0) + 1.0)(1), 2.0),
        ),  # contents
    ],
)
def test_what_is_the_same_is_compiled_once_and_what_is_another_anew(place, one, other):
    for compilations, (call, value) in ((1, one), (0, one), (1, other), (0, one), (0, other)):
        assert compiled_by(call) == (compilations, value)


def test_what_is_unknown_is_not_kept(place):
    @compile_cache.njit
    def reading(entry):
        return entry + len(unknown_type)

    unknown_type = (1.0, object)  # a class of which nothing is known
    with pytest.raises(numba.core.errors.TypingError):
        reading(1)
    assert not place.exists()


@pytest.mark.parametrize("mode", [0o777, 0o770, 0o722])
def test_a_folder_that_others_can_write_is_not_used(place, mode):
    place.mkdir()
    place.chmod(mode)
    assert compiled_by(lambda: function(7.0)(1.0)) == (1, 7.0)
    assert not [*place.iterdir()]
    place.chmod(0o700)
    assert compiled_by(lambda: function(7.0)(1.0)) == (1, 7.0)
    (file,) = place.iterdir()
    file.chmod(0o666)
    assert compiled_by(lambda: function(7.0)(1.0)) == (1, 7.0)


ANOTHER = type("Other", (str,), {"flatten": str})("another")


@pytest.mark.parametrize(
    "change",
    [
        *(
            lambda patch, of=of: patch.setattr(of, "__version__", "another")
            for of in (numba, np, compile_cache.llvmlite, mujoco)
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
    place, tmp_path, monkeypatch, change
):
    monkeypatch.setattr(compile_cache, "_PACKAGE", tmp_path)
    (tmp_path / "a.py").write_text("x = 1")
    compile_cache._foundation.cache_clear()
    before = compile_cache._path("name", ())
    change(monkeypatch)
    compile_cache._foundation.cache_clear()
    assert compile_cache._path("name", ()) != before
    monkeypatch.undo()
    compile_cache._foundation.cache_clear()


def test_where_numba_is_installed_is_not_in_the_key(place, monkeypatch):
    before = compile_cache._path("name", ())
    monkeypatch.setattr(numba.config, "__file__", "/elsewhere/numba/core/config.py")
    compile_cache._foundation.cache_clear()
    assert compile_cache._path("name", ()) == before
    compile_cache._foundation.cache_clear()


def test_what_was_not_used_for_long_makes_room(place, monkeypatch):
    function(1.5)(1.0)
    (old,) = place.iterdir()
    os.utime(old, (1.0, 1.0))
    monkeypatch.setattr(compile_cache, "MOST", old.stat().st_size + 100)
    function(2.5)(1.0)
    (new,) = place.iterdir()
    assert new != old


def test_another_thing_under_the_same_name_gets_another(monkeypatch):
    monkeypatch.setattr(compile_cache, "_SYMBOLS", {})
    numbers = np.arange(4)
    first, second = (
        compile_cache.linked("codrl_mj_test", numbers[at:].ctypes.data) for at in (0, 2)
    )
    assert first != second
    assert compile_cache.linked("codrl_mj_test", numbers.ctypes.data) == first


def test_the_command_line_shows_and_clears_it(place, monkeypatch, capsys):
    def told(*flags):
        assert main(["cache", *flags]) == 0
        return capsys.readouterr().out

    assert "empty" in told()
    function(3.5)(1.0)
    shown = told()
    assert str(place) in shown
    assert "1 file" in shown
    told("--clear")
    assert not [*place.iterdir()]
    monkeypatch.setenv("CODRL_MJ_CACHE", "off")
    assert compile_cache.folder() is None
    assert "off" in told()
