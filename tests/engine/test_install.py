"""Installation is idempotent, and does not replace callbacks of other libraries."""

import mujoco
import pytest

from codrl_mj import engine
from codrl_mj.actuators import IDEAL, DCMotorActuator
from codrl_mj.physics import MujocoPhysics, SimulationConfig, trace_names
from codrl_mj.tasks import TASKS

pytestmark = pytest.mark.usefixtures("bare_engine")


def _foreign_control(model, data):
    pass


def _foreign_act_bias(model, data, index):
    return 0.0


FOREIGN = {"control": _foreign_control, "act_bias": _foreign_act_bias}


def _present():
    return {name: getattr(mujoco, f"get_mjcb_{name}")() for name in FOREIGN}


def _set(name, callback):
    getattr(mujoco, f"set_mjcb_{name}")(callback)


def test_install_and_uninstall_are_idempotent():
    engine.uninstall()
    assert not engine.installed()
    engine.install()
    once = _present()
    assert engine.installed()
    assert None not in once.values()
    engine.install()
    assert all(_present()[name] is once[name] for name in once)
    for _ in range(2):
        engine.uninstall()
        assert not engine.installed()
        assert _present() == {"control": None, "act_bias": None}
    engine.install()
    assert all(_present()[name] is once[name] for name in once)


@pytest.mark.parametrize("name", FOREIGN)
def test_callbacks_of_other_libraries_are_neither_replaced_nor_removed(name):
    _set(name, FOREIGN[name])
    with pytest.raises(
        engine.CallbackInUseError, match=f"mjcb_{name} is already set.*set_mjcb_{name}.None."
    ):
        engine.install()
    expected = {"control": None, "act_bias": None, name: FOREIGN[name]}
    assert _present() == expected
    assert not engine.installed()
    _set(name, None)
    engine.install()
    _set(name, FOREIGN[name])
    engine.uninstall()
    assert _present() == expected


@pytest.mark.parametrize("name", FOREIGN)
def test_installed_is_false_while_one_callback_is_missing(name):
    engine.install()
    _set(name, None)
    assert not engine.installed()
    engine.install()
    assert engine.installed()


def test_install_raises_for_an_unknown_group():
    with pytest.raises(ValueError, match="callbacks 'engine': must be one of motor"):
        engine.install("engine")


def test_a_step_raises_if_the_callback_was_replaced_and_works_after_a_reset_without_it():
    physics = MujocoPhysics(SimulationConfig(TASKS["cartpole"], [DCMotorActuator()], 1, "euler"))
    mujoco.set_mjcb_control(FOREIGN["control"])
    with pytest.raises(engine.CallbackInUseError):
        physics.reset(physics.state)
    mujoco.set_mjcb_control(None)
    physics.reset(physics.state)
    physics.step(5.0)
    assert physics.trace[-1, 0, trace_names(DCMotorActuator).index("current")] > 0.0


def test_an_ideal_actuator_needs_no_callback():
    mujoco.set_mjcb_act_bias(FOREIGN["act_bias"])
    physics = MujocoPhysics(SimulationConfig(TASKS["cartpole"], [IDEAL], 1, "euler"))
    physics.step(10.0)
    assert physics.state[1] > 0.0
