"""Motors in models that are copied, saved and loaded: the same motor, or a clear error."""

import copy
import itertools
import os
import pickle
import re
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest

import codrl_mj
from codrl_mj.actuators import Lag, import_path
from codrl_mj.plugin import NAME, registered
from tests.add_motors.models import (
    GYMNASIUM,
    INTEGRATORS,
    LOOP,
    NOISY,
    SUITE,
    Worn,
    arm,
    behind_plugin,
    controls,
    own_controls,
    trajectory,
)
from tests.matrix import but

pytestmark = pytest.mark.filterwarnings(
    "ignore::UserWarning"
)  # deprecated attributes in other people's models

TWO = {"one": NOISY, "two": Worn()}


def through_file(model, folder):
    mujoco.mj_saveModel(model, str(folder / "model.mjb"), None)
    return mujoco.MjModel.from_binary_path(str(folder / "model.mjb"))


RELOADED = {
    "copy": lambda model, _: copy.copy(model),
    "deepcopy": lambda model, _: copy.deepcopy(model),
    "pickle": lambda model, _: pickle.loads(pickle.dumps(model)),
    "mjb": through_file,
    "copied spec": lambda *_: codrl_mj.add_motors(arm(), TWO).copy().compile(),
}


@pytest.mark.parametrize("how", RELOADED)
def test_a_model_keeps_its_motors(how, tmp_path):
    model, inputs = behind_plugin(arm(), TWO), controls(100, 2)
    again = RELOADED[how](model, tmp_path)
    assert codrl_mj.engine.motors(again) == {0: NOISY, 1: Worn()}
    np.testing.assert_array_equal(trajectory(again, inputs), trajectory(model, inputs))


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_an_xml_file_keeps_motors_to_its_six_digits(integrator, tmp_path):
    """Numbers of at most six digits survive, and with them the actuator, its gain and its bias."""
    spec = arm(integrator)
    spec.actuator("two").set_to_position(kp=7.25, kv=0.5)
    motors_added = codrl_mj.add_motors(spec, {"one": NOISY, "two": "lag"})
    path = tmp_path / "model.xml"
    path.write_text(motors_added.to_xml())
    model, again = motors_added.compile(), mujoco.MjModel.from_xml_path(str(path))
    assert codrl_mj.engine.motors(again) == {0: NOISY, 1: Lag()}
    inputs = controls(100, 2)
    np.testing.assert_array_equal(trajectory(again, inputs), trajectory(model, inputs))
    third = NOISY.replaced({"motor.resistance": 4 / 3})
    again = mujoco.MjModel.from_xml_string(codrl_mj.add_motors(spec, {"one": third}).to_xml())
    assert codrl_mj.engine.motors(again)[0].motor.resistance == 1.33333


def test_gain_and_bias_are_in_the_xml_every_time():
    """What is not initialised in MuJoCo is a matter of luck."""
    for _ in range(40):
        spec = arm().copy()
        spec.actuator("two").set_to_position(kp=7.25, kv=0.5)
        model = mujoco.MjModel.from_xml_string(codrl_mj.add_motors(spec, {".*": "ideal"}).to_xml())
        assert model.actuator_biasprm[1, :3].tolist() == [0.0, -7.25, -0.5]
        assert model.actuator_gainprm[:, 0].tolist() == [1.0, 7.25]


HUMANOID = [(path, "implicitfast") for path in GYMNASIUM if path.stem == "humanoid"]
ROBOTS = [*itertools.product([*GYMNASIUM, *SUITE], INTEGRATORS)]


@pytest.mark.parametrize(
    ("path", "integrator"), but(HUMANOID, ROBOTS), ids=lambda one: getattr(one, "stem", one)
)
def test_robots_saved_and_loaded_are_as_before(path, integrator):
    """Ideal actuators saved and loaded are what the model without them is, saved and loaded."""
    spec = mujoco.MjSpec.from_file(str(path))
    spec.option.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}")
    spec.meshdir, spec.texturedir = (
        str(path.parent / folder) for folder in (spec.meshdir, spec.texturedir)
    )
    spec.compile()
    plain = mujoco.MjModel.from_xml_string(spec.to_xml())
    ours = mujoco.MjModel.from_xml_string(codrl_mj.add_motors(spec, {".*": "ideal"}).to_xml())
    inputs = own_controls(plain, 100 if (path, integrator) in HUMANOID else 500)
    np.testing.assert_array_equal(trajectory(ours, inputs), trajectory(plain, inputs))


_ANOTHER_PROCESS = """
import mujoco, numpy as np
try:
    mujoco.MjModel.from_xml_path("model.xml")
except ValueError as error:
    print(repr(str(error)))
import codrl_mj
def final(model):
    data = mujoco.MjData(model)
    for index in range(50):
        data.ctrl[:] = 0.1 * (index % 7)
        mujoco.mj_step(model, data)
    print(*data.qpos.tolist())
try:
    mujoco.MjModel.from_xml_path("somebody.xml")
except ValueError as error:
    print(repr(str(error)))
final(mujoco.MjModel.from_binary_path("model.mjb"))
final(mujoco.MjModel.from_xml_path("model.xml"))
from tests.add_motors.models import Worn
codrl_mj.engine.load_family(Worn)
final(mujoco.MjModel.from_xml_path("somebody.xml"))
"""


def test_another_process_has_the_same_motors_and_imports_no_code_because_a_model_says_so(tmp_path):
    inputs = 0.1 * (np.arange(50) % 7)[:, np.newaxis] * np.ones(2)
    ours = codrl_mj.add_motors(arm(), {"one": LOOP, "two": "torque_speed"})
    somebodys = codrl_mj.add_motors(arm(), {"one": Worn()})
    (tmp_path / "model.xml").write_text(ours.to_xml())
    (tmp_path / "somebody.xml").write_text(somebodys.to_xml())
    mujoco.mj_saveModel(ours.compile(), str(tmp_path / "model.mjb"), None)
    options = {
        "cwd": tmp_path,
        "env": {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])},
        "timeout": 300,
    }
    command = [sys.executable, "-c", _ANOTHER_PROCESS]
    result = subprocess.run(command, **options, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    without, refused, *found = result.stdout.splitlines()
    assert "plugin codrl_mj.actuator not found" in without
    assert (
        "its family 'tests.add_motors.models:Worn' is not loaded, and is not imported because a"
        " model" in refused
    )
    expected = []
    for model in (ours.compile(), ours.compile(), somebodys.compile()):
        data = mujoco.MjData(model)
        trajectory(model, inputs, data)
        expected.append(" ".join(map(repr, data.qpos.tolist())))
    assert found == expected


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ("250700 ", "2507 ", "user data do not begin with codrl_mj's signature"),
        (import_path(Lag), import_path(type(LOOP)), "name different families"),
        (import_path(Lag), "codrl_mj.actuators:Nobody", "'codrl_mj.actuators:Nobody' is not loaded"),
        (" 0.3 0.007", "", "fewer numbers than the family has parameters"),
    ],
)
def test_what_does_not_agree_is_refused_when_it_is_loaded(old, new, reason):
    text = codrl_mj.add_motors(arm(), {"one": Lag(time_constant=0.3, delay=0.007)}).to_xml()
    text = re.sub(
        r'<size nuser_actuator="\d+"/>', "", text
    )  # so that it is as long as it has to be
    mujoco.MjModel.from_xml_string(text)
    assert old in text
    with pytest.raises(
        ValueError, match=f"plugin->init failed(.|\n)*{NAME}: plugin instance 0: .*{reason}"
    ):
        mujoco.MjModel.from_xml_string(text.replace(old, new))


def swap_families(model):
    model.actuator_user[:, 2] = model.actuator_user[::-1, 2]


def set_user(entry, value):
    def change(model):
        model.actuator_user[0, entry] = value

    return change


def register_anew(model):
    model.plugin[:] = (
        0  # as in an .mjb file from a process where plugins were registered in another order
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (register_anew, f"plugin slot = 0: a motor of codrl_mj needs {registered()[NAME][0]}"),
        (set_user(0, 1.0), "its actuator's user data do not begin with codrl_mj's signature"),
        (swap_families, "family = 'codrl_mj.actuators.current_loop:Actuator' of its plugin"),
        (set_user(2, 123.0), "family 123 is not known in this process: import its module and call"),
        (set_user(4, -1.0), r"Motor\.resistance = -1\.0: must be"),
    ],
)
def test_a_model_whose_motors_do_not_agree_with_their_plugins_is_refused(change, message):
    model = behind_plugin(arm(), TWO)
    change(model)
    with pytest.raises(ValueError, match=f"^one: {message}"):
        codrl_mj.engine.motors(model)
