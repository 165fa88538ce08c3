"""`motors_added`: models that others' code builds get motors, and nothing else is changed."""

import subprocess
import sys
import threading

import gymnasium as gym
import mujoco
import pytest

import codrl_mj
from codrl_mj.actuators import Lag
from codrl_mj.external_envs.building import Building
from tests.external_envs.models import ARM

LOADERS = ("from_xml_path", "from_xml_string")
PLAIN = {name: vars(mujoco.MjModel)[name] for name in LOADERS}
BALL = "<mujoco><worldbody><body><freejoint/><geom size='1'/></body></worldbody></mujoco>"
ARM_FROM_FILE = "<mujoco><include file='arm.xml'/></mujoco>"


@pytest.fixture(autouse=True)
def _nothing_is_left():
    yield
    assert {name: vars(mujoco.MjModel)[name] for name in LOADERS} == PLAIN


def _families(model):
    return {
        model.actuator(index).name: type(motor)
        for index, motor in codrl_mj.engine.motors(model).items()
    }


def test_models_from_files_text_and_environments_get_motors_inside_and_none_outside(tmp_path):
    path = tmp_path / "arm.xml"
    path.write_text(ARM)
    with codrl_mj.motors_added({"servo": "lag", "elbow": "lag", "b.*": "lag"}):
        models = [mujoco.MjModel.from_xml_path(str(path)), mujoco.MjModel.from_xml_string(xml=ARM)]
        models.append(mujoco.MjModel.from_xml_string(ARM_FROM_FILE, {"arm.xml": ARM.encode()}))
        ball, env = mujoco.MjModel.from_xml_string(BALL), gym.make("HalfCheetah-v5")
    building = Building({"servo": Lag(0.1)})
    with building.motorising():  # as composer environments build theirs at every reset
        assert [_families(mujoco.MjModel.from_xml_string(ARM)) for _ in range(3)] == [
            {"servo": Lag}
        ] * 3
    assert len(building._met) == 1
    with pytest.raises(ZeroDivisionError), codrl_mj.motors_added({"servo": "lag"}):
        raise ZeroDivisionError  # passes, and everything is as before
    assert [_families(model) for model in models] == [{"servo": Lag, "motor": Lag}] * 3
    assert list(codrl_mj.engine.motors(env.unwrapped.model)) == [0, 1, 2]
    assert ball.nplugin == 0  # without a match it is left alone where others have one
    assert not codrl_mj.engine.motors(mujoco.MjModel.from_xml_string(ARM))


def test_of_nested_blocks_the_innermost_counts():
    with codrl_mj.motors_added({"servo": "lag"}):
        with codrl_mj.motors_added({"motor": "lag"}):
            inner = mujoco.MjModel.from_xml_string(ARM)
        outer = mujoco.MjModel.from_xml_string(ARM)
    assert (*_families(inner), *_families(outer)) == ("motor", "servo")


def test_threads_have_motors_of_their_own():
    """Each enters before and leaves after another builds: whoever restores too early or too late shows."""
    barrier, found = threading.Barrier(3), {}

    def build(name):
        with codrl_mj.motors_added({name: "lag"}):
            barrier.wait()
            found[name] = _families(mujoco.MjModel.from_xml_string(ARM))
            if name == "motor":
                barrier.wait()
        if name == "servo":
            barrier.wait()

    def build_plain():
        barrier.wait()
        found["plain"] = _families(mujoco.MjModel.from_xml_string(ARM))
        barrier.wait()

    threads = [threading.Thread(target=build, args=(name,)) for name in ("servo", "motor")]
    threads.append(threading.Thread(target=build_plain))
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert found == {"servo": {"servo": Lag}, "motor": {"motor": Lag}, "plain": {}}


@pytest.mark.parametrize(
    ("actuators", "text"),
    [
        (
            {"wheel": "lag"},
            r"'wheel': no actuator has such a name.*there are servo, shoulder, motor, elbow",
        ),
        ("lag", "must be a mapping of patterns"),
        ({".*": {"family": "lag", "delay": 1.0}}, "must be <= 0.08 s"),
    ],
)
def test_what_is_wrong_is_said(actuators, text):
    with pytest.raises(ValueError, match=text), codrl_mj.motors_added(actuators):
        mujoco.MjModel.from_xml_string(ARM)


def test_a_block_in_which_nothing_is_built_is_an_error():
    with (
        pytest.raises(ValueError, match=r"no model was built inside.*codrl_mj.add_motors"),
        codrl_mj.motors_added({".*": "lag"}),
    ):
        mujoco.MjSpec.from_string(ARM).compile()


@pytest.mark.matrix
def test_first_use_of_a_drive_builds_nothing_of_ours_with_motors():
    """Layout checks build a model of their own within the building of the first one: in a process that is new."""
    code = (
        "import codrl_mj, mujoco\n"
        "with codrl_mj.motors_added({'.*': 'maxon-ec45-flat-50w'}):\n"
        f"    model = mujoco.MjModel.from_xml_string({ARM!r})\n"
        "print(len(codrl_mj.engine.motors(model)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "2\n"
