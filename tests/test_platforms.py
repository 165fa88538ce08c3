"""No use of what Windows and macOS lack: Unix file locks, /proc, fork (not tested on them)."""

import json
import subprocess
import sys

import pytest

ELSEWHERE = """
import importlib, os, pathlib, pkgutil, sys

import filelock, matplotlib, stable_baselines3, tensorboard, torch  # which ask what system it is: Linux

for name in ("fcntl", "grp", "pty", "pwd", "resource", "termios"):
    sys.modules[name] = None
for name in ("fork", "getpgid", "getuid", "killpg", "register_at_fork", "sched_getaffinity", "sysconf"):
    if hasattr(os, name):
        delattr(os, name)
found = pathlib.Path.exists
pathlib.Path.exists = lambda path, **options: not path.is_relative_to("/proc") and found(path, **options)

import codrl_mj

SIMULATORS = {"warp", "mujoco_warp", "mjlab", "jax"}
for module in pkgutil.walk_packages(codrl_mj.__path__, "codrl_mj."):
    try:
        importlib.import_module(module.name)
    except ModuleNotFoundError as error:  # An adapter of a simulator that is not installed.
        if not module.name.startswith("codrl_mj.arrays.") or error.name not in SIMULATORS:
            raise
from codrl_mj import cli

sys.exit(cli.main(sys.argv[1:]))
"""


@pytest.mark.matrix
def test_imports_and_training_use_no_module_that_other_systems_lack(tmp_path):
    words = ["train", "cartpole", "--total-steps", "512", "--out", str(tmp_path / "run")]
    process = subprocess.run(
        [sys.executable, "-c", ELSEWHERE, *words], capture_output=True, text=True, timeout=300
    )
    assert process.returncode == 0, process.stderr
    assert json.loads((tmp_path / "run" / "result.json").read_text())["steps"] >= 512


@pytest.mark.matrix
def test_a_run_folder_in_use_is_refused_by_any_lock(tmp_path):
    """Two processes use a run folder, and one of them holds its lock."""
    hold = "import sys; from codrl_mj.training.folder import locked; from pathlib import Path\n"
    hold += "with locked(Path(sys.argv[1])): print('held', flush=True); sys.stdin.read()"
    holder = subprocess.Popen(
        [sys.executable, "-c", hold, str(tmp_path)], stdin=-1, stdout=-1, text=True
    )
    assert holder.stdout.readline() == "held\n"
    lock = subprocess.run(
        [sys.executable, "-c", hold, str(tmp_path)], capture_output=True, text=True, input=""
    )
    assert "another process is training in it" in lock.stderr
    holder.kill()  # The operating system releases the lock.
    holder.wait()
    after = subprocess.run(
        [sys.executable, "-c", hold, str(tmp_path)], capture_output=True, text=True, input=""
    )
    assert after.stdout == "held\n"
