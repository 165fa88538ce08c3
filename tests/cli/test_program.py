"""The command line as a separate program."""

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
    """Check in a new process, where nothing has been imported yet."""
    code = (
        f"import sys; sys.modules[{missing!r}] = None; from codrl_mj.cli import main;"
        " sys.exit(main(sys.argv[1:]))"
    )
    result = program(sys.executable, "-c", code, *f"train cartpole {TINY} --out run".split())
    assert result.returncode == 2
    assert result.stderr.startswith("codrl-mj: error: ")
    assert f"{missing} is not installed" in result.stderr
    assert "pip install" in result.stderr
    assert list(tmp_path.iterdir()) == []


def test_the_program_prints_its_version_and_refuses_bad_input_with_status_2(tmp_path):
    assert program(PROGRAM, "--version").stdout == f"codrl-mj {codrl_mj.__version__}\n"
    result = program(PROGRAM, "train", "cartpole", "--actuator", "weakr")
    assert result.returncode == 2
    assert result.stderr.count("\n") == 1
    assert result.stderr.startswith("codrl-mj: error: unknown actuator 'weakr'")
    assert list(tmp_path.iterdir()) == []


def test_the_program_ends_quietly_if_its_output_is_closed():
    result = program("bash", "-c", f"{sys.executable} -m codrl_mj train pendulum --help | head -1")
    assert result.stdout.startswith("usage: codrl-mj train")
    assert result.stderr == ""


HELP_AND_LOOKUP = """
import contextlib, sys
from codrl_mj import catalogue, cli
for words in ("--help", "motor list"):
    with contextlib.suppress(SystemExit):
        cli.main(words.split())
[catalogue.motor_entry(name) for name in catalogue.motor_names()]
heavy = (
    *("torch", "numba", "stable_baselines3", "scipy", "matplotlib", "imageio", "dm_control"),
    *("rich.progress", "pint"),
)
print("loaded:", [name for name in heavy if name in sys.modules])
"""


def test_help_and_motor_lookup_import_no_heavy_library():
    assert program(sys.executable, "-c", HELP_AND_LOOKUP).stdout.splitlines()[-1] == "loaded: []"


INTERRUPT_AN_IMPORT = """
import os, signal, sys
class Stop:
    def find_spec(self, name, *_):
        if name == 'tyro':
            os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Stop())
"""


@pytest.mark.parametrize("words", [[str(PROGRAM)], [sys.executable, "-m", "codrl_mj"]])
def test_ctrl_c_during_the_imports_prints_one_line(words):
    """Interrupt the first import of a library."""
    Path("sitecustomize.py").write_text(INTERRUPT_AN_IMPORT)
    path = os.pathsep.join([str(Path.cwd()), *filter(None, sys.path)])
    result = program(*words, "--help", env=os.environ | {"PYTHONPATH": path})
    assert (result.returncode, result.stderr) == (
        130,
        "codrl-mj: stopped before it started\n",
    )
