"""The control callback and the plugin run the same actuators: bit for bit, whatever happens in between."""

import copy
import itertools
import pickle

import mujoco
import numpy as np
import pytest
from mujoco import rollout
from mujoco.batch import Batch

import codrl_mj
from codrl_mj.actuators import TorqueSpeed
from tests.add_motors.models import (
    ACTUATORS,
    INTEGRATORS,
    LOOP,
    NOISY,
    arm,
    behind_callback,
    behind_plugin,
    controls,
    full_state,
    trajectory,
)
from tests.matrix import but

pytestmark = pytest.mark.usefixtures("bare_engine")

STEPS = 200


def _both(actuators, integrator, kind="hinge"):
    """Positions, speeds and signals at both doors after each step."""
    found, motors, count = [], list(actuators.values()), len(actuators)
    for build in (behind_callback, behind_plugin):
        model = build(arm(integrator, kind), actuators)
        data, read, rows, shaft = (
            mujoco.MjData(model),
            codrl_mj.engine.Readout(model),
            [],
            np.ones(2),
        )
        codrl_mj.engine.clear_motors(data, range(5, 5 + count))
        if (
            build is behind_callback
        ):  # where a control is the torque at the shaft, or the shaft's motion
            shaft[:count] = [
                (1 / one.arm_radius if one.MOTION else one.arm_radius) for one in motors
            ]
        for desired in controls(STEPS, 2):
            data.ctrl[:] = desired * shaft
            mujoco.mj_step(model, data)
            seen = read(data)
            # one door stores the force, the other makes it from the torque
            wanted = np.where([one.is_torque_controlled for one in motors], desired[:count], seen["actual_force"])
            np.testing.assert_allclose(seen.pop("desired_force"), wanted, rtol=1e-15)
            rows.append(np.concatenate((data.qpos, data.qvel, data.qfrc_actuator, *seen.values())))
        assert list(codrl_mj.engine.motors(model).values()) == motors
        found.append(np.array(rows))
    return found


ALONE = [(name, None, "hinge") for name in ACTUATORS]
MIXED = ("noisy_current_loop", "somebody's", "slide")
PAIRS = [*ALONE, *itertools.product(ACTUATORS, ACTUATORS, ["hinge", "slide"])]


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize(("first", "second", "kind"), but([*ALONE, MIXED], PAIRS))
def test_both_doors_agree(first, second, kind, integrator):
    second = {} if second is None else {"two": ACTUATORS[second]}
    callback, plugin = _both({"one": ACTUATORS[first], **second}, integrator, kind)
    np.testing.assert_array_equal(plugin, callback)
    assert second or np.isfinite(plugin).all()  # two families lack what the other has


def of_state(what):
    def restored(data):
        state = np.empty(mujoco.mj_stateSize(data.model, what))
        mujoco.mj_getState(data.model, data, state, what)
        other = mujoco.MjData(data.model)
        mujoco.mj_setState(data.model, other, state, what)
        return other

    return restored


SAVED = {
    "state": of_state(mujoco.mjtState.mjSTATE_FULLPHYSICS),
    "integration": of_state(mujoco.mjtState.mjSTATE_INTEGRATION),
    "copy": copy.copy,
    "pickle": lambda data: pickle.loads(pickle.dumps(data)),
}


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("how", SAVED)
def test_a_simulation_is_continued_from_what_is_saved_of_it(how, integrator):
    """Whatever forward calls there are meanwhile, and wherever the saved one goes."""
    model, inputs = (
        behind_plugin(arm(integrator), {"one": NOISY, "two": ACTUATORS["lag"]}),
        controls(STEPS, 2),
    )

    def meddle(data):
        mujoco.mj_forward(model, data)
        mujoco.mj_step(model, copy.copy(data), 5)

    data = mujoco.MjData(model)
    first = trajectory(model, inputs[:70], data)
    other = SAVED[how](data)
    mujoco.mj_step(model, data, 3)  # the first goes its own way
    rest = trajectory(other.model, inputs[70:], other, before_step=meddle)
    np.testing.assert_array_equal(np.concatenate((first, rest)), trajectory(model, inputs))


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_a_reset_and_a_keyframe_bring_motors_to_rest(integrator):
    spec = arm(integrator)
    spec.add_key(name="late", qpos=[0.1, -0.2], time=3.0)
    model = behind_plugin(spec, {"one": LOOP, "two": ACTUATORS["lag"]})
    inputs, fresh, used = controls(STEPS, 2), mujoco.MjData(model), mujoco.MjData(model)
    trajectory(model, inputs, used)
    mujoco.mj_resetData(model, used)
    assert not used.plugin_state.any()
    np.testing.assert_array_equal(trajectory(model, inputs, used), trajectory(model, inputs, fresh))
    # the time of a keyframe is not that of the motors' rest: under RK4 the first step must be held
    # as all others are
    mujoco.mj_resetDataKeyframe(model, used, 0)
    plain = mujoco.MjData(model)
    plain.qpos[:] = used.qpos
    np.testing.assert_allclose(
        trajectory(model, inputs, used), trajectory(model, inputs, plain), rtol=0, atol=1e-11
    )


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("share", [0.3, 1.0, 1.7])
def test_after_a_keyframe_s_time_a_step_takes_no_torque_from_before(integrator, share):
    spec, found = arm(integrator), []
    spec.add_key(name="later", time=share * 0.005, qpos=[0.1, -0.2])
    for model in (spec.copy().compile(), behind_plugin(spec, {".*": TorqueSpeed(1e6, 1e6, 1e6)})):
        data = mujoco.MjData(model)
        data.ctrl[:] = 0.3
        mujoco.mj_step(model, data, 3)
        mujoco.mj_resetDataKeyframe(model, data, 0)
        data.ctrl[:] = -0.5
        mujoco.mj_step(model, data, 2)
        found.append(np.concatenate([data.qpos, data.qvel]))
    np.testing.assert_allclose(found[1], found[0], rtol=1e-6)


def test_several_families_of_one_model_are_each_as_if_alone():
    """Two separate joints: what drives one has nothing to do with the other."""
    spec = mujoco.MjSpec()
    for name in ACTUATORS:
        body = spec.worldbody.add_body(pos=[len(spec.bodies), 0, 0])
        body.add_joint(name=name, axis=[0, 1, 0])
        body.add_geom(size=[0.1, 0, 0], mass=1, pos=[0, 0, -0.2], contype=0, conaffinity=0)
        spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    inputs = controls(STEPS, len(ACTUATORS))
    together = trajectory(codrl_mj.add_motors(spec, ACTUATORS).compile(), inputs)
    count = len(ACTUATORS)
    for index, (name, actuator) in enumerate(ACTUATORS.items()):
        alone = trajectory(codrl_mj.add_motors(spec, {name: actuator}).compile(), inputs)
        for column in (index, count + index, 2 * count + index):
            np.testing.assert_array_equal(together[:, column], alone[:, column])


@pytest.mark.parametrize("nthread", [1, 2])
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_a_batch_is_a_loop(integrator, nthread):
    """Each simulation with its own motors."""
    nsim, steps = 8, 60
    resistances = np.linspace(0.8, 2.0, nsim)
    actuators = [LOOP.replaced({"motor.resistance": value}) for value in resistances]
    models = [
        behind_plugin(arm(integrator), {"one": one, "two": ACTUATORS["lag"]}) for one in actuators
    ]
    inputs = [controls(steps, 2, seed) for seed in range(nsim)]
    batch = Batch(models[0], nsim=nsim, nthread=nthread)
    batch.expand("actuator_user")[:] = [model.actuator_user for model in models]
    ctrl, qpos, state = batch.bind("ctrl"), batch.bind("qpos"), batch.bind("plugin_state")
    for step in range(steps):
        ctrl[:] = [one[step] for one in inputs]
        batch.step()
    for sim, model in enumerate(models):
        data = mujoco.MjData(model)
        trajectory(model, inputs[sim], data)
        np.testing.assert_array_equal(qpos[sim], data.qpos)
        np.testing.assert_array_equal(state[sim], data.plugin_state)
    assert len(np.unique(qpos[:, 0])) == nsim


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_a_rollout_is_a_loop(integrator):
    model = behind_plugin(arm(integrator), {"one": NOISY, "two": ACTUATORS["torque_speed"]})
    inputs = np.array([controls(50, 2, seed) for seed in range(6)])
    start = full_state(mujoco.MjData(model))
    states, _ = rollout.rollout(model, [mujoco.MjData(model) for _ in range(2)], start, inputs)
    for sequence, found in zip(inputs, states, strict=True):
        data = mujoco.MjData(model)
        trajectory(model, sequence, data)
        np.testing.assert_array_equal(found[-1], full_state(data))


def test_a_set_state_needs_motors_cleared_and_then_they_are():
    model = behind_plugin(arm("RK4"), {"one": NOISY, "two": ACTUATORS["lag"]})
    inputs, used = controls(STEPS, 2), mujoco.MjData(model)
    trajectory(model, inputs, used)
    after = []
    for cleared in (False, True):
        data = copy.copy(used)
        data.qpos[:], data.qvel[:], data.time = 0.0, 0.0, 0.25
        data.qacc_warmstart[:] = 0.0
        if cleared:
            codrl_mj.engine.clear_motors(data)
        after.append(trajectory(model, inputs[:20], data))
    fresh = mujoco.MjData(model)
    fresh.time = 0.25
    expected = trajectory(model, inputs[:20], fresh)
    np.testing.assert_array_equal(after[1], expected)
    assert not np.allclose(after[0], expected, atol=1e-3)


def test_noise_has_the_key_that_it_is_given():
    model = behind_plugin(arm(), {"one": NOISY, "two": NOISY})
    inputs, ends = controls(50, 2), []
    for keys in ((1, 2), (1, 2), (2, 1)):
        data = mujoco.MjData(model)
        codrl_mj.engine.clear_motors(data, keys)
        ends.append(trajectory(model, inputs, data))
    np.testing.assert_array_equal(ends[0], ends[1])
    assert not np.array_equal(ends[0], ends[2])


def test_actuation_switched_off_and_on_again_is_the_same_at_both_doors():
    found = []
    for build in (behind_callback, behind_plugin):
        model = build(arm(), {"one": LOOP.replaced({"motor.arm_radius": 1.0})})

        def switch(data, model=model):
            flag = mujoco.mjtDisableBit.mjDSBL_ACTUATION
            step = round(data.time / model.opt.timestep)
            model.opt.disableflags = flag if 20 <= step < 30 else 0

        found.append(trajectory(model, controls(60, 2), before_step=switch)[:, :4])
    np.testing.assert_array_equal(*found)
