"""Use of all that codrl-mj-core offers: a program for an environment with this wheel.

It prints, as JSON, the folder of the package, the missing package and the modules that were refused.
"""

import ctypes
import importlib
import json
import os
import pkgutil
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

import codrl_mj
from codrl_mj.actuators import FAMILIES, Drive, Inputs, parameters_type, resolve
from codrl_mj.arrays import advance, c_function, check_family
from codrl_mj.catalogue import motor_entry, motor_names, new_motor
from codrl_mj.cli import main
from codrl_mj.envs.distributions import Uniform
from codrl_mj.requirements import MissingPackageError, simulation_problem
from codrl_mj.sizing import drive_limits, find_drive

MOTOR = "maxon-ec45-flat-50w"
SLOW_MOTOR = """
from codrl_mj.actuators import Lag
SLOW = Lag(time_constant=0.2)
"""
PENDULUM = """
<mujoco>
  <worldbody>
    <body><joint name="hinge"/><geom type="sphere" size="0.1" pos="0 0 -0.5"/></body>
  </worldbody>
  <actuator><motor joint="hinge"/></actuator>
</mujoco>
"""
SIMULATORS = {"mujoco", "mujoco_warp", "warp", "mjlab", "torch", "jax"}
"""Modules that adapters to simulators import, beyond what the core requires."""
MAIN = """
int main_(double *torque) {
    struct motor_state before = {0}, after;
    struct motor_inputs inputs = {0.1, 0.0, 5.0, 0.0, 0.0};
    struct motor_signals signals;
    *torque = motor(0.002, &before, &inputs, &after, &signals);
    return 0;
}
"""


def use_names_and_files():
    """Resolve actuators by every kind of name."""
    assert len(motor_names()) > 10
    assert type(resolve(MOTOR, None, "a robot")) is Drive
    assert drive_limits(find_drive(MOTOR, gear_ratio=20.0)).stall_torque > 10.0
    new_motor(Path("template.toml"))
    datasheet = Path(codrl_mj.__file__).parent / "_assets" / "motors" / f"{MOTOR}.toml"
    shutil.copy(datasheet, "bought.toml")
    assert motor_entry("bought.toml").parameters == motor_entry(MOTOR).parameters
    Path("slow.yaml").write_text("family: lag\ntime_constant: 0.2\n")
    Path("slow_motor.py").write_text(SLOW_MOTOR)
    sys.path.insert(0, "")
    assert resolve("slow.yaml", None, "a robot") == resolve("slow_motor:SLOW", None, "a robot")
    assert Uniform(0.8, 1.2).high == 1.2


def use_back_ends():
    """Compare one step of a motor on arrays and in C with plain Python."""
    for family in FAMILIES.values():
        check_family(family)
    motor = resolve(MOTOR, None, "a robot")
    parameters = parameters_type(Drive)(*motor.parameter_values)
    state = Drive.State(*[0.0] * len(Drive.State._fields))
    inputs = Inputs(0.1, 0.0, 5.0, 0.0, 0.0)
    expected = Drive.advance(parameters, 0.002, state, inputs)[1]
    assert expected > 0.0
    libraries = [np]
    if "torch" in {module.name for module in pkgutil.iter_modules()}:
        libraries.append(importlib.import_module("torch"))
    for library in libraries:
        speeds = library.linspace(5.0, 6.0, 3, dtype=library.float64)
        lanes = Drive.State(*[0.0 * speeds for _ in state])
        torque = advance(Drive, library, parameters, 0.002, lanes, inputs._replace(speed=speeds))[1]
        assert abs(float(torque[0]) - expected) < 1e-12
    if compiler := shutil.which("gcc"):
        Path("motor.c").write_text(c_function(motor, name="motor") + MAIN)
        subprocess.run(
            [compiler, "-shared", "-fPIC", "-o", "motor.so", "motor.c", "-lm"], check=True
        )
        torque = ctypes.c_double()
        ctypes.CDLL("./motor.so").main_(ctypes.byref(torque))
        assert torque.value == expected


def use_a_model():
    """Match motors with a model, where MuJoCo is installed."""
    mujoco = importlib.import_module("mujoco")
    prepare_model = importlib.import_module("codrl_mj.arrays").prepare_model
    spec = mujoco.MjSpec.from_string(PENDULUM)
    robot = prepare_model(spec, {".*": {"name": MOTOR, "motor": {"gear_ratio": 20.0}}})
    assert robot.spec.joint("hinge").armature == robot.motors[0].actuator.additions.armature > 0.0


def refused_modules():
    """Return the modules that cannot be imported here; each error has to name the remedy."""
    refused = []
    modules = pkgutil.walk_packages(codrl_mj.__path__, "codrl_mj.", onerror=lambda _: None)
    for name in [module.name for module in modules]:
        try:
            importlib.import_module(name)
        except MissingPackageError as error:
            if not str(error).endswith(simulation_problem()):
                raise
            refused.append(name)
        except ModuleNotFoundError as error:
            if error.name not in SIMULATORS:
                raise
    return refused


os.chdir(tempfile.mkdtemp())
use_names_and_files()
use_back_ends()
if "mujoco" in {module.name for module in pkgutil.iter_modules()}:
    use_a_model()
assert main(["motor", "list"]) == 0
assert main(["motor", "write", MOTOR, "--as", "c", "--out", "written.c"]) == 0
assert main(["motor", "write", MOTOR, "--as", "mjlab", "--out", "written.py"]) == 0
assert main(["train", "pendulum"]) == 2
try:
    codrl_mj.make("pendulum")
    raise AssertionError("an environment was made")
except MissingPackageError as error:
    message = str(error)
print(json.dumps({"file": codrl_mj.__file__, "message": message, "refused": refused_modules()}))
