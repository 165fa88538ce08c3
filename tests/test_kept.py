"""Compiled code that is kept on disk: what was changed is compiled anew, what is damaged or not ours is not used."""

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import numba
import numpy as np
import pytest
from numba.core import event

from codrl_mj import kept
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
import sys, time
sys.path.insert(0, sys.argv[1])
import numba
from numba.core import event
import codrl_mj
compiled = []

class Counted(event.Listener):
    def on_start(self, it):
        compiled.append(it)

    def on_end(self, it):
        pass

event.register("numba:compile", Counted())
actuator = sys.argv[2]
if ":" in actuator:
    import importlib
    module, name = actuator.split(":")
    actuator = getattr(importlib.import_module(module), name)()
env = codrl_mj.make(sys.argv[3], actuator)
seen = [env.reset(seed=3)[0].tolist()] + [env.step(env.action_space.low * 0 + 0.3)[0].tolist() for _ in range(20)]
print(len(compiled), seen)
"""


@pytest.fixture
def place(tmp_path, monkeypatch):
    """An empty folder to keep code in."""
    monkeypatch.setenv("CODRL_MJ_CACHE", str(tmp_path / "kept"))
    return tmp_path / "kept"


def process(folder, actuator="lag", env="InvertedPendulum-v5", cache=None, **variables):
    """How much a new process compiled, and what it saw."""
    (folder / "steps.py").write_text(STEPS)
    environment = {**os.environ, **({} if cache is None else {"CODRL_MJ_CACHE": str(cache)}), **variables}
    command = [sys.executable, str(folder / "steps.py"), str(folder), actuator, env]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True, timeout=300)
    count, seen = done.stdout.split(" ", 1)
    return int(count), seen


@pytest.fixture(scope="module")
def filled(tmp_path_factory):
    """A folder that one process filled, and what that process saw."""
    folder = tmp_path_factory.mktemp("filled")
    count, seen = process(folder, cache=folder / "kept")
    assert count > 10
    return folder, seen


def test_the_next_process_compiles_nothing_and_sees_the_same_as_without(filled):
    folder, seen = filled
    assert process(folder, cache=folder / "kept") == (0, seen)
    count, again = process(folder, cache="off")
    assert count > 10
    assert again == seen


TWINS = """
import math, sys
from codrl_mj import kept
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
""".replace("LONG", "        total += math.sin(value) + math.cos(total) * math.exp(-total * total)\n" * 40)


def test_functions_of_one_name_that_two_processes_compiled_stay_apart(tmp_path):
    """Each is the first of its process, so that a count would call them alike."""

    def run(*factors):
        environment = {**os.environ, "CODRL_MJ_CACHE": str(tmp_path / "kept")}
        command = [sys.executable, "-c", TWINS, *map(str, factors)]
        return subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout.strip()

    for factor in (2.0, 5.0, 7.0):
        run(factor)
    assert len([*(tmp_path / "kept").iterdir()]) == 3
    assert run(2.0, 5.0, 7.0) == "[12.0, 30.0, 42.0]"
    assert run(7.0, 3.0, 2.0) == "[42.0, 18.0, 12.0]"


@pytest.mark.parametrize("variables", [{"NUMBA_CPU_NAME": "generic"}, {"NUMBA_OPT": "1"}])
def test_code_of_another_cpu_or_of_other_settings_is_not_used(filled, variables):
    folder, seen = filled
    count, _ = process(folder, cache=folder / "kept", **variables)
    assert count > 10
    assert process(folder, cache=folder / "kept") == (0, seen)


def test_what_is_damaged_is_compiled_anew(filled, tmp_path):
    folder, seen = filled
    files = sorted((folder / "kept").iterdir())
    before = {file: file.read_bytes() for file in files}
    for number, file in enumerate(files):
        content = before[file]
        file.write_bytes([content[:-1], b"", content[:32] + b"x" * 500, os.urandom(200)][number % 4])
    count, again = process(folder, cache=folder / "kept")
    assert count > 10
    assert again == seen
    assert {file.name for file in (folder / "kept").iterdir()} == {file.name for file in files}  # written anew
    assert process(folder, cache=folder / "kept") == (0, seen)


def test_two_processes_at_once_leave_whole_files(tmp_path):
    with ThreadPoolExecutor(2) as both:
        found = [*both.map(lambda _: process(tmp_path, cache=tmp_path / "kept"), range(2))]
    assert len({seen for _, seen in found}) == 1
    assert not [*(tmp_path / "kept").glob("*.part")]
    assert process(tmp_path, cache=tmp_path / "kept") == (0, found[0][1])


def test_a_change_deep_in_somebodys_own_modules_is_seen(tmp_path):
    """A constant in a helper of a helper: of the value alone, of the code alone, and back."""

    def write(factor, added):
        (tmp_path / "own.py").write_text(FAMILY)
        (tmp_path / "deeper.py").write_text(HELPER.format(added=added))
        (tmp_path / "constants.py").write_text(f"FACTOR = {factor}\n")

    def seen():
        return process(tmp_path, "own:Spring", cache=tmp_path / "kept", PYTHONDONTWRITEBYTECODE="1")

    write(1.0, 0.0)
    _, first = seen()
    assert seen() == (0, first)
    write(2.0, 0.0)
    count, other = seen()
    assert count > 0
    assert other != first
    write(1.0, 0.25)
    count, third = seen()
    assert count > 0
    assert len({first, other, third}) == 3
    write(1.0, 0.0)
    assert seen() == (0, first)


@pytest.mark.skipif(not hasattr(os, "getuid") or os.getuid() == 0, reason="root may write everywhere")
def test_a_folder_that_cannot_be_written_is_no_error(tmp_path):
    (tmp_path / "kept").mkdir(mode=0o500)
    count, _ = process(tmp_path, cache=tmp_path / "kept")
    assert count > 10


def test_where_no_folder_can_be_nothing_is_kept(tmp_path):
    (tmp_path / "file").touch()
    count, _ = process(tmp_path, cache=tmp_path / "file" / "inside")
    assert count > 10


def function(factor):
    """A function that closes over a number; its own code is the same for every one."""

    @kept.njit(nogil=True)
    def scaled(value):
        return factor * value

    return scaled


class Compiled(event.Listener):
    """Counts compilations."""

    count = 0

    def on_start(self, _):
        self.count += 1

    def on_end(self, _):
        pass


def compiled_by(call):
    """How many compilations a call took, and what it returned."""
    listener = Compiled()
    with event.install_listener("numba:compile", listener):
        value = call()
    return listener.count, value


def test_what_a_function_closes_over_counts(place):
    assert compiled_by(lambda: function(2.0)(3.0)) == (1, 6.0)
    assert compiled_by(lambda: function(2.0)(3.0)) == (0, 6.0)
    assert compiled_by(lambda: function(4.0)(3.0)) == (1, 12.0)
    assert compiled_by(lambda: function(2.0)(3)) == (1, 6.0)  # of other types


def test_options_count(place):
    def divided(by):
        return 1.0 / by

    assert compiled_by(lambda: kept.njit(divided, error_model="numpy")(0.0)) == (1, np.inf)
    with pytest.raises(ZeroDivisionError):
        kept.njit(divided)(0.0)
    assert compiled_by(lambda: kept.njit(divided, error_model="numpy")(0.0)) == (0, np.inf)


def test_an_array_counts_by_its_content_and_what_is_unknown_is_not_kept(place):
    array = np.arange(3.0)

    def of(table):
        @kept.njit
        def first(entry):
            return table[entry]

        return first

    assert compiled_by(lambda: of(array)(1)) == (1, 1.0)
    assert compiled_by(lambda: of(array.copy())(1)) == (0, 1.0)
    assert compiled_by(lambda: of(array + 1.0)(1)) == (1, 2.0)
    before = len([*place.iterdir()])

    @kept.njit
    def reading(entry):
        return entry + len(unknown_type)

    unknown_type = (1.0, object)  # a class of which nothing is known
    with pytest.raises(numba.core.errors.TypingError):
        reading(1)
    assert len([*place.iterdir()]) == before


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


def test_a_changed_layout_or_version_is_another_key(place, monkeypatch):
    assert compiled_by(lambda: function(8.0)(1.0)) == (1, 8.0)
    monkeypatch.setattr(kept, "_foundation", lambda: b"another MuJoCo")
    assert compiled_by(lambda: function(8.0)(1.0)) == (1, 8.0)


@pytest.mark.parametrize("module", [numba, np, kept.llvmlite, kept.mujoco])
def test_every_version_is_in_the_key(module, monkeypatch):
    before = kept._foundation.__wrapped__()
    monkeypatch.setattr(module, "__version__", "another")
    assert kept._foundation.__wrapped__() != before


def test_this_packages_source_is_in_the_key(tmp_path, monkeypatch):
    (tmp_path / "a.py").write_text("x = 1")
    monkeypatch.setattr(kept, "_PACKAGE", tmp_path)
    before = kept._foundation.__wrapped__()
    (tmp_path / "a.py").write_text("x = 2")
    assert kept._foundation.__wrapped__() != before


def test_an_offset_of_mujocos_structures_is_in_the_key(place):
    """What reads a field has the offset in its closure."""
    from codrl_mj.engine.layout import DATA, MODEL

    paths = {kept._path("field", (one,)) for one in (MODEL.nv, MODEL.nu, DATA.time)}
    assert len(paths) == 3
    assert None not in paths


def test_what_was_not_used_for_long_makes_room(place, monkeypatch):
    function(1.5)(1.0)
    (old,) = place.iterdir()
    os.utime(old, (1.0, 1.0))
    monkeypatch.setattr(kept, "MOST", old.stat().st_size + 100)
    function(2.5)(1.0)
    (new,) = place.iterdir()
    assert new != old


def test_another_thing_under_the_same_name_gets_another(monkeypatch):
    monkeypatch.setattr(kept, "_SYMBOLS", {})
    numbers = np.arange(4)
    first, second = (kept.linked("codrl_mj_test", numbers[at:].ctypes.data) for at in (0, 2))
    assert first != second
    assert kept.linked("codrl_mj_test", numbers.ctypes.data) == first


def test_the_command_line_shows_and_clears_it(place, capsys):
    assert main(["cache"]) == 0
    assert "empty" in capsys.readouterr().out
    function(3.5)(1.0)
    assert main(["cache"]) == 0
    told = capsys.readouterr().out
    assert str(place) in told
    assert "1 file" in told
    assert main(["cache", "--clear"]) == 0
    assert not [*place.iterdir()]


def test_off_keeps_nothing(monkeypatch, capsys):
    monkeypatch.setenv("CODRL_MJ_CACHE", "off")
    assert kept.folder() is None
    assert main(["cache"]) == 0
    assert "off" in capsys.readouterr().out
