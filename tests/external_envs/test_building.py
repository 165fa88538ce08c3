"""`motors_added` adds motors to models that third-party code builds, and changes nothing else."""

import subprocess
import sys
import threading

import gymnasium as gym
import mujoco
import pytest

import codrl_mj
from codrl_mj.actuators import Lag
from codrl_mj.external_envs.building import ModelPatcher
from tests.external_envs.models import ARM

LOADERS = ("from_xml_path", "from_xml_string")
ORIGINAL_LOADERS = {name: vars(mujoco.MjModel)[name] for name in LOADERS}
BALL = "<mujoco><worldbody><body><freejoint/><geom size='1'/></body></worldbody></mujoco>"
ARM_FROM_FILE = "<mujoco><include file='arm.xml'/></mujoco>"


@pytest.fixture(autouse=True)
def _loaders_are_restored():
    yield
    assert {name: vars(mujoco.MjModel)[name] for name in LOADERS} == ORIGINAL_LOADERS


def _families(model):
    return {
        model.actuator(index).name: type(motor)
        for index, motor in codrl_mj.engine.motors(model).items()
    }


def test_models_get_motors_inside_the_block_and_none_outside(tmp_path):
    path = tmp_path / "arm.xml"
    path.write_text(ARM)
    with codrl_mj.motors_added({"servo": "lag", "elbow": "lag", "b.*": "lag"}):
        models = [mujoco.MjModel.from_xml_path(str(path)), mujoco.MjModel.from_xml_string(xml=ARM)]
        models.append(mujoco.MjModel.from_xml_string(ARM_FROM_FILE, {"arm.xml": ARM.encode()}))
        ball, env = mujoco.MjModel.from_xml_string(BALL), gym.make("HalfCheetah-v5")
    patcher = ModelPatcher({"servo": Lag(0.1)})
    # Composer environments build their model at every reset in this way.
    with patcher.patch_model_loading():
        assert [_families(mujoco.MjModel.from_xml_string(ARM)) for _ in range(3)] == [
            {"servo": Lag}
        ] * 3
    assert len(patcher._names_of_models) == 1
    # The exception passes, and the functions are restored.
    with pytest.raises(ZeroDivisionError), codrl_mj.motors_added({"servo": "lag"}):
        raise ZeroDivisionError
    assert [_families(model) for model in models] == [{"servo": Lag, "motor": Lag}] * 3
    assert list(codrl_mj.engine.motors(env.unwrapped.model)) == [0, 1, 2]
    # A model without a match stays as it is if another one has a match.
    assert ball.nplugin == 0
    assert not codrl_mj.engine.motors(mujoco.MjModel.from_xml_string(ARM))


def test_the_innermost_of_nested_blocks_applies():
    with codrl_mj.motors_added({"servo": "lag"}):
        with codrl_mj.motors_added({"motor": "lag"}):
            inner = mujoco.MjModel.from_xml_string(ARM)
        outer = mujoco.MjModel.from_xml_string(ARM)
    assert (*_families(inner), *_families(outer)) == ("motor", "servo")


def test_each_thread_adds_its_own_motors():
    """Each thread enters its block before, and leaves it after, another thread builds a model."""
    barrier, families = threading.Barrier(3), {}

    def build(name):
        with codrl_mj.motors_added({name: "lag"}):
            barrier.wait()
            families[name] = _families(mujoco.MjModel.from_xml_string(ARM))
            if name == "motor":
                barrier.wait()
        if name == "servo":
            barrier.wait()

    def build_plain():
        barrier.wait()
        families["plain"] = _families(mujoco.MjModel.from_xml_string(ARM))
        barrier.wait()

    threads = [threading.Thread(target=build, args=(name,)) for name in ("servo", "motor")]
    threads.append(threading.Thread(target=build_plain))
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert families == {"servo": {"servo": Lag}, "motor": {"motor": Lag}, "plain": {}}


@pytest.mark.parametrize(
    ("actuators", "message"),
    [
        (
            {"wheel": "lag"},
            r"'wheel': no actuator has such a name.*there are servo, shoulder, motor, elbow",
        ),
        ("lag", "must be a mapping of patterns"),
        ({".*": {"family": "lag", "delay": 1.0}}, "must be <= 0.08 s"),
    ],
)
def test_raises_for_wrong_arguments(actuators, message):
    with pytest.raises(ValueError, match=message), codrl_mj.motors_added(actuators):
        mujoco.MjModel.from_xml_string(ARM)


def test_raises_if_no_model_is_built_in_the_block():
    with (
        pytest.raises(ValueError, match=r"no model was built in the block.*codrl_mj.add_motors"),
        codrl_mj.motors_added({".*": "lag"}),
    ):
        mujoco.MjSpec.from_string(ARM).compile()


@pytest.mark.matrix
def test_layout_checks_build_their_models_without_motors():
    """In a new process, layout checks build a model of their own while the first model is built."""
    code = (
        "import codrl_mj, mujoco\n"
        "with codrl_mj.motors_added({'.*': 'maxon-ec45-flat-50w'}):\n"
        f"    model = mujoco.MjModel.from_xml_string({ARM!r})\n"
        "print(len(codrl_mj.engine.motors(model)))"
    )
    process = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert process.stdout == "2\n"
