"""The core wheel in one environment with mjlab, which pins an older MuJoCo than our engine needs."""

import importlib.metadata
import json
import shutil
import time
from pathlib import Path

import mujoco
import numpy as np
import pytest

from tests.arrays.models import STEPS, our_motion, square_waves, with_our_motors
from tests.bare_environment import BareEnvironment
from tests.simulators.rod import ROD

REPOSITORY = Path(__file__).parents[2]
MJLAB = "mjlab==1.6.0"
LINKED = ("torch", "scipy", "matplotlib", "tensorboard", "viser", "trimesh", "warp-lang")
"""Packages that mjlab requires too, and that take long to install: those of this environment."""
VERSIONS = """
import importlib.metadata, json
names = ("mujoco", "mujoco-warp", "warp-lang", "torch", "mjlab", "codrl-mj-core")
print(json.dumps({name: importlib.metadata.version(name) for name in names}))
"""
PENDULUMS = """
import json, sys
import numpy as np
from tests.simulators.rods import Pendulums
commands = np.load("commands.npy")
np.save("angles.npy", Pendulums(commands.shape[1], motor=json.loads(sys.argv[1])).push(commands))
"""
MOTOR = {
    "name": "maxon-ec45-flat-50w",
    "motor": {"gear_ratio": 20.0, "gear_efficiency": 0.85},
    "controller": {"max_current": 6.0},
}
OLD_MUJOCO = """
import codrl_mj
try:
    import codrl_mj.engine.control
except ImportError as error:
    print(error)
"""

pytestmark = pytest.mark.slow


def size(folder):
    """Return the size of a folder's own files [MB]."""
    files = (file for file in folder.rglob("*") if file.is_file() and not file.is_symlink())
    return sum(file.stat().st_size for file in files) / 1e6


@pytest.fixture(scope="module")
def environment(tmp_path_factory):
    """Return an environment with mjlab, its pins, and then the core, both installed by pip."""
    environment = BareEnvironment(tmp_path_factory.mktemp("mjlab"))
    installed = {entry.name for entry in importlib.metadata.distributions()}
    versions = environment.link(name for name in LINKED if name in installed)
    # pip must not replace a linked package, because the link leads to this environment.
    constraints = environment.folder / "constraints.txt"
    constraints.write_text("".join(f"{name}=={versions[name]}\n" for name in versions))
    process = environment.pip("install", "--quiet", "--constraint", constraints, MJLAB)
    if process.returncode:
        pytest.skip(f"NOT RUN: pip cannot install {MJLAB}: {process.stderr[-500:]}")
    before, start = size(environment.library), time.perf_counter()
    core = REPOSITORY / "wheels" / "core"
    process = environment.pip("install", "--quiet", "--constraint", constraints, core)
    assert process.returncode == 0, process.stderr
    seconds = time.perf_counter() - start
    print(f"core: {seconds:.1f} s, {size(environment.library) - before:.1f} MB of {before:.0f} MB")
    return environment


def test_pip_installs_the_core_beside_the_pins_of_mjlab(environment):
    process = environment.pip("check")
    assert process.returncode == 0, process.stdout
    versions = json.loads(environment.run("-c", VERSIONS).stdout)
    assert versions["mujoco"].startswith("3.11.")
    assert versions["mujoco-warp"].startswith("3.11.")
    assert versions["torch"] == importlib.metadata.version("torch")
    print(versions)


def test_motors_and_back_ends_work_there(environment):
    shutil.copy(REPOSITORY / "tests" / "core_use.py", environment.folder / "use.py")
    process = environment.run("use.py")
    assert process.returncode == 0, process.stdout + process.stderr
    answer = json.loads(process.stdout.splitlines()[-1])
    assert Path(answer["file"]).is_relative_to(environment.folder)
    assert answer["message"].endswith("pip install codrl-mj")


def test_a_motor_moves_a_pendulum_of_mjlab_as_our_engine_does(environment):
    """Run mjlab's own loop there, and our engine on its newer MuJoCo in this environment."""
    commands = square_waves(STEPS, 4)
    np.save(environment.folder / "commands.npy", commands)
    (environment.folder / "tests" / "simulators").mkdir(parents=True)
    for name in ("rod.py", "rods.py"):
        shutil.copy(REPOSITORY / "tests/simulators" / name, environment.folder / "tests/simulators")
    process = environment.run("-c", PENDULUMS, json.dumps(MOTOR))
    assert process.returncode == 0, process.stdout + process.stderr
    angles = np.load(environment.folder / "angles.npy")
    actuator = '<actuator><motor name="motor" joint="hinge"/></actuator>'
    rod = ROD.format(option='<option timestep="0.002"/>', actuator=actuator)
    model = with_our_motors(mujoco.MjSpec.from_string(rod), {"motor": MOTOR})
    gap = np.abs(angles - our_motion([model] * 4, commands)[..., 0])
    print("largest gap", gap.max(), "range", np.ptp(angles))
    assert np.ptp(angles) > 1.0
    assert gap.max() < 1e-5


def test_numba_and_gymnasium_do_not_make_the_older_mujoco_usable(environment):
    environment.link(["numba", "gymnasium"])
    process = environment.run("-c", OLD_MUJOCO)
    assert process.returncode == 0, process.stderr
    assert (
        "codrl_mj.engine.control cannot be imported: it needs MuJoCo 3.17 or newer, and 3.11."
        in (process.stdout)
    )
