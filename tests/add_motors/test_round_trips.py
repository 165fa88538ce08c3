"""Models that are copied, saved and loaded have the same motors, or give a clear error."""

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
from codrl_mj.plugin import NAME, registered_plugins
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
from tests.matrix import matrix_params

# Third-party models have deprecated attributes.
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")

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


@pytest.mark.parametrize("method", RELOADED)
def test_a_model_keeps_its_motors(method, tmp_path):
    model, inputs = behind_plugin(arm(), TWO), controls(100, 2)
    again = RELOADED[method](model, tmp_path)
    assert codrl_mj.engine.motors(again) == {0: NOISY, 1: Worn()}
    np.testing.assert_array_equal(trajectory(again, inputs), trajectory(model, inputs))


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_an_xml_file_keeps_motors_to_its_six_digits(integrator, tmp_path):
    """Numbers with at most six digits are kept, and so are the actuator, its gain and its bias."""
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


def test_gain_and_bias_are_always_in_the_xml():
    """MuJoCo does not initialize some fields, so that one run is not enough."""
    for _ in range(40):
        spec = arm().copy()
        spec.actuator("two").set_to_position(kp=7.25, kv=0.5)
        model = mujoco.MjModel.from_xml_string(codrl_mj.add_motors(spec, {".*": "ideal"}).to_xml())
        assert model.actuator_biasprm[1, :3].tolist() == [0.0, -7.25, -0.5]
        assert model.actuator_gainprm[:, 0].tolist() == [1.0, 7.25]


HUMANOID = [(path, "implicitfast") for path in GYMNASIUM if path.stem == "humanoid"]
ROBOTS = [*itertools.product([*GYMNASIUM, *SUITE], INTEGRATORS)]


@pytest.mark.parametrize(
    ("path", "integrator"),
    matrix_params(HUMANOID, ROBOTS),
    ids=lambda value: getattr(value, "stem", value),
)
def test_saved_and_loaded_robots_are_unchanged(path, integrator):
    """A saved and loaded model behaves the same with ideal actuators and without them."""
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
    mujoco.MjModel.from_xml_path("custom.xml")
except ValueError as error:
    print(repr(str(error)))
final(mujoco.MjModel.from_binary_path("model.mjb"))
final(mujoco.MjModel.from_xml_path("model.xml"))
from tests.add_motors.models import Worn
codrl_mj.engine.load_family(Worn)
final(mujoco.MjModel.from_xml_path("custom.xml"))
"""


def test_another_process_has_the_same_motors_and_a_model_cannot_import_code(tmp_path):
    inputs = 0.1 * (np.arange(50) % 7)[:, np.newaxis] * np.ones(2)
    ours = codrl_mj.add_motors(arm(), {"one": LOOP, "two": "torque_speed"})
    custom = codrl_mj.add_motors(arm(), {"one": Worn()})
    (tmp_path / "model.xml").write_text(ours.to_xml())
    (tmp_path / "custom.xml").write_text(custom.to_xml())
    mujoco.mj_saveModel(ours.compile(), str(tmp_path / "model.mjb"), None)
    options = {
        "cwd": tmp_path,
        "env": {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])},
        "timeout": 300,
    }
    command = [sys.executable, "-c", _ANOTHER_PROCESS]
    result = subprocess.run(command, **options, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    without, refused, *outputs = result.stdout.splitlines()
    assert "plugin codrl_mj.actuator not found" in without
    assert (
        "its family 'tests.add_motors.models:Worn' is not loaded, and a model must not"
        " import code" in refused
    )
    expected = []
    for model in (ours.compile(), ours.compile(), custom.compile()):
        data = mujoco.MjData(model)
        trajectory(model, inputs, data)
        expected.append(" ".join(map(repr, data.qpos.tolist())))
    assert outputs == expected


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ("250700 ", "2507 ", "user data do not begin with codrl_mj's signature"),
        (import_path(Lag), import_path(type(LOOP)), "name different families"),
        (
            import_path(Lag),
            "codrl_mj.actuators:Missing",
            "'codrl_mj.actuators:Missing' is not loaded",
        ),
        (" 0.3 0.007", "", "fewer numbers than the family has parameters"),
    ],
)
def test_inconsistent_models_raise_when_they_are_loaded(old, new, reason):
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
        (
            register_anew,
            f"plugin slot = 0: a motor of codrl_mj needs {registered_plugins()[NAME][0]}",
        ),
        (set_user(0, 1.0), "its actuator's user data do not begin with codrl_mj's signature"),
        (swap_families, "family = 'codrl_mj.actuators.current_loop:DCMotorActuator' of its plugin"),
        (set_user(2, 123.0), "family 123 is not known in this process: import its module and call"),
        (set_user(4, -1.0), r"Motor\.resistance = -1\.0: must be"),
    ],
)
def test_a_model_whose_motors_do_not_agree_with_their_plugins_is_refused(change, message):
    model = behind_plugin(arm(), TWO)
    change(model)
    with pytest.raises(ValueError, match=f"^one: {message}"):
        codrl_mj.engine.motors(model)
