"""The wheel is complete and works without the checkout, and an index accepts it."""

import os
import re
import site
import subprocess
import sys
import tarfile
import venv
import zipfile
from pathlib import Path

import pytest

from tests.test_docs import RUN, shortened

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
def built(tmp_path_factory):
    """Return a folder with the source distribution and the wheel that is built from it.

    Both are built by `python -m build`.
    """
    out = tmp_path_factory.mktemp("built")
    build = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(out), str(REPOSITORY)]
    result = subprocess.run(build, capture_output=True, text=True, timeout=240, check=False)
    assert result.returncode == 0, result.stdout + result.stderr
    return out


@pytest.fixture(scope="module")
def wheel(built):
    (path,) = built.glob("*.whl")
    return zipfile.ZipFile(path)


@pytest.fixture(scope="module")
def program(wheel, tmp_path_factory):
    """Return a function that runs a program of an environment with the wheel and its dependencies.

    The dependencies are those of this environment.
    """
    folder = tmp_path_factory.mktemp("environment")
    venv.create(folder, symlinks=True)
    programs = folder / ("Scripts" if os.name == "nt" else "bin")
    python = programs / "python"
    install = [
        sys.executable,
        "-m",
        "pip",
        "--python",
        str(python),
        "install",
        "--quiet",
        "--no-deps",
        wheel.filename,
    ]
    subprocess.run(install, check=True, timeout=240)
    query = "import sysconfig; print(sysconfig.get_path('purelib'))"
    site_packages = Path(
        subprocess.run(
            [python, "-c", query], capture_output=True, text=True, check=True
        ).stdout.strip()
    )
    paths = [path for path in sys.path if Path(path).name == "site-packages"]
    (site_packages / "dependencies.pth").write_text("\n".join([*site.getsitepackages(), *paths]))
    clean = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}

    def run(name, *arguments, cwd):
        words = [programs / name, *arguments]
        result = subprocess.run(
            words, cwd=cwd, env=clean, capture_output=True, text=True, timeout=300, check=False
        )
        assert result.returncode == 0, (
            f"{arguments}: {result.stdout[-1000:]}{result.stderr[-1000:]}"
        )
        return result.stdout

    run.folder = folder
    return run


@pytest.fixture(scope="module")
def metadata(wheel):
    """Return the lines of the wheel's metadata."""
    (name,) = (name for name in wheel.namelist() if name.endswith("METADATA"))
    return wheel.read(name).decode().splitlines()


def test_the_wheel_has_every_module_model_and_the_type_marker(wheel):
    names = set(wheel.namelist())
    package, assets = REPOSITORY / "codrl_mj", REPOSITORY / "assets"

    def source_files(pattern, min_files):
        files = {path.relative_to(REPOSITORY).as_posix() for path in package.glob(pattern)}
        assert len(files) >= min_files
        return files

    models = {
        f"codrl_mj/_assets/{path.relative_to(assets).as_posix()}"
        for path in assets.rglob("*")
        if path.is_file()
    }
    assert len(models) >= 5
    pages = {
        f"codrl_mj/viz/pages/{name}"
        for name in ("page.html.jinja", "parts.html.jinja", "page.css", "page.js")
    }
    pages |= {
        f"codrl_mj/viz/pages/uplot/{name}"
        for name in ("uPlot.iife.min.js", "uPlot.min.css", "LICENSE")
    }
    pages |= {f"codrl_mj/viz/replay/{name}" for name in ("page.html", "replay.css", "replay.js")}
    pages |= {
        f"codrl_mj/viz/replay/three/{name}" for name in ("three.min.js", "LICENSE", "README.md")
    }
    others = {
        "codrl_mj/py.typed",
        *(f"codrl_mj/_assets/study/{study}/runs.csv" for study in ("actuators", "insurance")),
    }
    settings = source_files("rl_zoo3/*.yml", 5) | source_files("agents/presets/*.toml", 6)
    assert names >= source_files("**/*.py", 30) | models | settings | pages | others
    assert not [name for name in names if name.startswith(("tests", "scripts", "assets", "docs"))]


def test_the_wheel_has_the_program_the_version_and_the_license(wheel, metadata):
    (info,) = {name.split("/")[0] for name in wheel.namelist() if ".dist-info/" in name}
    assert "codrl-mj = codrl_mj.__main__:main" in wheel.read(f"{info}/entry_points.txt").decode()
    version = (
        (REPOSITORY / "codrl_mj" / "__init__.py")
        .read_text()
        .partition('__version__ = "')[2]
        .partition('"')[0]
    )
    assert f"Version: {version}" in metadata
    assert f"{info}/licenses/LICENSE" in wheel.namelist()


def test_the_training_and_rendering_libraries_are_extras(metadata):
    needed = [
        line for line in metadata if line.startswith("Requires-Dist: ") and "extra ==" not in line
    ]
    core = {line.split()[1].split("<")[0].split(">")[0] for line in needed}
    assert core == {
        *("filelock", "gymnasium[mujoco]", "mujoco", "numba", "numpy"),
        *("pint", "platformdirs", "pyyaml", "rich", "scipy", "tyro"),
    }


def test_the_wheel_steps_and_renders_every_task(program, tmp_path):
    first, has_evidence, *tasks = program("python", "-c", USE, cwd=tmp_path).splitlines()
    assert Path(first).is_relative_to(program.folder)
    assert has_evidence == "True"
    assert len(tasks) == 6
    assert all(line.endswith("(48, 64, 3) True True") for line in tasks), tasks


def test_the_source_distribution_has_what_the_checkout_has(built):
    (path,) = built.glob("*.tar.gz")
    with tarfile.open(path) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    needed = {
        "README.md",
        "CHANGELOG.md",
        "LICENSE",
        "pyproject.toml",
        "examples/the_whole_idea.py",
        "docs/index.md",
    }
    assert names >= needed | {
        "tests/conftest.py",
        "scripts/demo.py",
        "assets/cartpole.xml",
        "docs/pictures/demo.gif",
    }
    assert not [name for name in names if name.startswith((".venv", "runs", "build"))]


def test_an_index_accepts_both_distributions(built):
    pytest.importorskip("twine")
    files = sorted(map(str, built.iterdir()))
    result = subprocess.run(
        [sys.executable, "-m", "twine", "check", "--strict", *files], capture_output=True, text=True
    )
    assert result.returncode == 0, result.stdout + result.stderr
    assert result.stdout.count("PASSED") == 2


def test_the_readme_works_with_only_the_wheel(program, tmp_path):
    """Run its Python, and shortened forms of its commands, with the installed program."""
    (block,) = re.findall(r"```python\n(.*?)```", (REPOSITORY / "README.md").read_text(), re.DOTALL)
    assert program("python", "-c", block, cwd=tmp_path).split()[0] == "10.0"
    for command in RUN["README.md"]:
        program("codrl-mj", *shortened(command), cwd=tmp_path)
    assert {"mine.html", "points", "runs"} <= {path.name for path in tmp_path.iterdir()}
