"""The wheel has all that a user needs, and works without the checkout."""

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[1]

USE = """
import gymnasium as gym
import numpy as np
import codrl_mj
from codrl_mj.study.evidence import Evidence
print(codrl_mj.__file__)
print(Evidence.read().loss("pendulum", "lag", 1.0) is not None)
for env_id in sorted(name for name in gym.registry if name.startswith("codrl_mj/")):
    env = gym.make(env_id, render_mode="rgb_array", width=64, height=48)
    env.reset(seed=0)
    _, _, _, _, info = env.step(env.action_space.sample())
    frame = env.render()
    print(env_id, frame.shape, frame.std() > 0, bool(np.isfinite(info["current"])))
    env.close()
"""


pytestmark = pytest.mark.matrix


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """The wheel, built from the checkout."""
    out = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(out), str(REPOSITORY)]
    done = subprocess.run(build, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    (path,) = out.glob("*.whl")
    return path


def test_the_wheel_has_every_module_model_and_the_type_marker(wheel):
    names = set(zipfile.ZipFile(wheel).namelist())
    package, assets = REPOSITORY / "codrl_mj", REPOSITORY / "assets"
    modules = {path.relative_to(REPOSITORY).as_posix() for path in package.rglob("*.py")}
    models = {f"codrl_mj/_assets/{path.relative_to(assets).as_posix()}" for path in assets.rglob("*") if path.is_file()}
    settings = {path.relative_to(REPOSITORY).as_posix() for path in (package / "rl_zoo3").glob("*.yml")}
    presets = {path.relative_to(REPOSITORY).as_posix() for path in (package / "agents" / "presets").glob("*.toml")}
    pages = {f"codrl_mj/pages/{name}" for name in ("page.html.jinja", "parts.html.jinja", "page.css", "page.js")}
    pages |= {f"codrl_mj/pages/uplot/{name}" for name in ("uPlot.iife.min.js", "uPlot.min.css", "LICENSE")}
    assert len(modules) > 30
    assert len(settings) == 5
    assert len(presets) == 6
    assert len(models) >= 5
    replay = {f"codrl_mj/replay/{name}" for name in ("page.html", "replay.css", "replay.js")}
    three = {f"codrl_mj/replay/three/{name}" for name in ("three.min.js", "LICENSE", "README.md")}
    others = {"codrl_mj/py.typed", "codrl_mj/_assets/study/runs.csv"}
    assert names >= modules | models | settings | presets | replay | three | pages | others
    assert not [name for name in names if name.startswith(("tests", "scripts", "assets", "docs"))]


def test_the_wheel_has_the_program_the_version_and_the_license(wheel):
    archive = zipfile.ZipFile(wheel)
    (info,) = {name.split("/")[0] for name in archive.namelist() if ".dist-info/" in name}
    assert "codrl-mj = codrl_mj.cli:main" in archive.read(f"{info}/entry_points.txt").decode()
    metadata = archive.read(f"{info}/METADATA").decode()
    version = (REPOSITORY / "codrl_mj" / "__init__.py").read_text().partition('__version__ = "')[2].partition('"')[0]
    assert f"Version: {version}" in metadata
    assert f"{info}/licenses/LICENSE" in archive.namelist()


def test_the_training_and_rendering_libraries_are_extras(wheel):
    archive = zipfile.ZipFile(wheel)
    (name,) = (name for name in archive.namelist() if name.endswith("METADATA"))
    needed = [line for line in archive.read(name).decode().splitlines() if line.startswith("Requires-Dist: ")]
    core = {line.split()[1].split("<")[0].split(">")[0] for line in needed if "extra ==" not in line}
    assert core == {"gymnasium", "mujoco", "numba", "numpy", "pint", "platformdirs", "rich", "tyro"}


def test_the_unpacked_wheel_steps_and_draws_every_task_from_another_folder(wheel, tmp_path):
    site, elsewhere = tmp_path / "site", tmp_path / "elsewhere"
    zipfile.ZipFile(wheel).extractall(site)
    elsewhere.mkdir()
    environment = os.environ | {"PYTHONPATH": str(site)}
    options = {"cwd": elsewhere, "env": environment, "capture_output": True, "text": True, "timeout": 120}
    done = subprocess.run([sys.executable, "-c", USE], check=False, **options)
    assert done.returncode == 0, done.stderr
    first, has_evidence, *tasks = done.stdout.splitlines()
    assert Path(first).is_relative_to(site)
    assert has_evidence == "True"
    assert len(tasks) == 6
    assert all(line.endswith("(48, 64, 3) True True") for line in tasks), tasks
