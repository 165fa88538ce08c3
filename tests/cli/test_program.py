"""The command line as a program of its own."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

import codrl_mj
from tests.cli.lines import TINY
from tests.matrix import matrix_params

PROGRAM = Path(sys.executable).with_name("codrl-mj")


def program(*words, **options):
    return subprocess.run(
        words, capture_output=True, text=True, timeout=120, check=False, **options
    )


@pytest.mark.parametrize(
    "missing", matrix_params(["torch"], ["torch", "stable_baselines3", "safetensors", "matplotlib"])
)
def test_a_missing_extra_is_named_before_anything_is_written(tmp_path, missing):
    """In a process of its own, where nothing has been imported yet."""
    code = (
        f"import sys; sys.modules[{missing!r}] = None; from codrl_mj.cli import main;"
        " sys.exit(main(sys.argv[1:]))"
    )
    done = program(sys.executable, "-c", code, *f"train cartpole {TINY} --out run".split())
    assert done.returncode == 2
    assert done.stderr.startswith("codrl-mj: error: ")
    assert f"{missing} is not installed" in done.stderr
    assert "pip install" in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_the_program_tells_its_version_and_refuses_bad_input_with_status_2_and_one_line(tmp_path):
    assert program(PROGRAM, "--version").stdout == f"codrl-mj {codrl_mj.__version__}\n"
    done = program(PROGRAM, "train", "cartpole", "--actuator", "weakr")
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert done.stderr.startswith("codrl-mj: error: unknown actuator 'weakr'")
    assert list(tmp_path.iterdir()) == []


def test_the_program_ends_quietly_if_its_reader_has_enough():
    done = program("bash", "-c", f"{sys.executable} -m codrl_mj train pendulum --help | head -1")
    assert done.stdout.startswith("usage: codrl-mj train")
    assert done.stderr == ""


LOOKED_UP = """
import contextlib, sys
from codrl_mj import catalogue, cli
for words in ("--help", "motor list"):
    with contextlib.suppress(SystemExit):
        cli.main(words.split())
[catalogue.motor_entry(one) for one in catalogue.motor_names()]
heavy = "torch", "numba", "stable_baselines3", "scipy", "matplotlib", "imageio", "dm_control", "rich.progress", "pint"
print("loaded:", [name for name in heavy if name in sys.modules])
"""


def test_neither_the_help_nor_looking_a_motor_up_loads_anything_heavy():
    assert program(sys.executable, "-c", LOOKED_UP).stdout.splitlines()[-1] == "loaded: []"


STOPPED_AT_AN_IMPORT = """
import os, signal, sys
class Stop:
    def find_spec(self, name, *_):
        if name == 'tyro':
            os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Stop())
"""


@pytest.mark.parametrize("words", [[str(PROGRAM)], [sys.executable, "-m", "codrl_mj"]])
def test_ctrl_c_while_the_program_is_imported_is_one_line(words):
    """At its first import of a library, whatever that takes."""
    Path("sitecustomize.py").write_text(STOPPED_AT_AN_IMPORT)
    path = os.pathsep.join([str(Path.cwd()), *filter(None, sys.path)])
    done = program(*words, "--help", env=os.environ | {"PYTHONPATH": path})
    assert (done.returncode, done.stderr) == (130, "codrl-mj: stopped before it started\n")
