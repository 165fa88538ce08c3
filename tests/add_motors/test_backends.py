"""The two backends, the control callback and the plugin, run the same actuators bit for bit."""

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
from tests.matrix import matrix_params

pytestmark = pytest.mark.usefixtures("bare_engine")

STEPS = 200


def _both(actuators, integrator, kind="hinge"):
    """Return positions, speeds and signals in both backends after each step."""
    results, motors, count = [], list(actuators.values()), len(actuators)
    for build in (behind_callback, behind_plugin):
        model = build(arm(integrator, kind), actuators)
        data, read, rows, shaft = (
            mujoco.MjData(model),
            codrl_mj.engine.Readout(model),
            [],
            np.ones(2),
        )
        codrl_mj.engine.clear_motors(data, range(5, 5 + count))
        # In the callback backend a control is the torque at the shaft, or the shaft's motion.
        if build is behind_callback:
            shaft[:count] = [
                (1 / motor.arm_radius if motor.MOTION else motor.arm_radius) for motor in motors
            ]
        for desired in controls(STEPS, 2):
            data.ctrl[:] = desired * shaft
            mujoco.mj_step(model, data)
            signals = read(data)
            # The plugin backend stores the force, the callback backend computes it from the torque.
            expected = np.where(
                [motor.is_torque_controlled for motor in motors],
                desired[:count],
                signals["actual_force"],
            )
            np.testing.assert_allclose(signals.pop("desired_force"), expected, rtol=1e-15)
            rows.append(
                np.concatenate((data.qpos, data.qvel, data.qfrc_actuator, *signals.values()))
            )
        assert list(codrl_mj.engine.motors(model).values()) == motors
        results.append(np.array(rows))
    return results


ALONE = [(name, None, "hinge") for name in ACTUATORS]
MIXED = ("noisy_current_loop", "custom", "slide")
PAIRS = [*ALONE, *itertools.product(ACTUATORS, ACTUATORS, ["hinge", "slide"])]


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize(("first", "second", "kind"), matrix_params([*ALONE, MIXED], PAIRS))
def test_both_backends_agree(first, second, kind, integrator):
    second = {} if second is None else {"two": ACTUATORS[second]}
    callback, plugin = _both({"one": ACTUATORS[first], **second}, integrator, kind)
    np.testing.assert_array_equal(plugin, callback)
    # With two families, each lacks signals of the other.
    assert second or np.isfinite(plugin).all()


def of_state(signature):
    def restored(data):
        state = np.empty(mujoco.mj_stateSize(data.model, signature))
        mujoco.mj_getState(data.model, data, state, signature)
        copied = mujoco.MjData(data.model)
        mujoco.mj_setState(data.model, copied, state, signature)
        return copied

    return restored


SAVED = {
    "state": of_state(mujoco.mjtState.mjSTATE_FULLPHYSICS),
    "integration": of_state(mujoco.mjtState.mjSTATE_INTEGRATION),
    "copy": copy.copy,
    "pickle": lambda data: pickle.loads(pickle.dumps(data)),
}


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("method", SAVED)
def test_a_simulation_continues_from_its_saved_state(method, integrator):
    """There are forward calls between steps, and the saved simulation is advanced meanwhile."""
    model, inputs = (
        behind_plugin(arm(integrator), {"one": NOISY, "two": ACTUATORS["lag"]}),
        controls(STEPS, 2),
    )

    def meddle(data):
        mujoco.mj_forward(model, data)
        mujoco.mj_step(model, copy.copy(data), 5)

    data = mujoco.MjData(model)
    first = trajectory(model, inputs[:70], data)
    saved = SAVED[method](data)
    # The original simulation goes on by itself.
    mujoco.mj_step(model, data, 3)
    rest = trajectory(saved.model, inputs[70:], saved, before_step=meddle)
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
    # The time of a keyframe differs from that of the motors' rest. With RK4 the force must be held
    # in the first step, as in all others.
    mujoco.mj_resetDataKeyframe(model, used, 0)
    plain = mujoco.MjData(model)
    plain.qpos[:] = used.qpos
    np.testing.assert_allclose(
        trajectory(model, inputs, used), trajectory(model, inputs, plain), rtol=0, atol=1e-11
    )


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("share", [0.3, 1.0, 1.7])
def test_a_step_after_a_keyframe_has_no_earlier_torque(integrator, share):
    spec, states = arm(integrator), []
    spec.add_key(name="later", time=share * 0.005, qpos=[0.1, -0.2])
    for model in (spec.copy().compile(), behind_plugin(spec, {".*": TorqueSpeed(1e6, 1e6, 1e6)})):
        data = mujoco.MjData(model)
        data.ctrl[:] = 0.3
        mujoco.mj_step(model, data, 3)
        mujoco.mj_resetDataKeyframe(model, data, 0)
        data.ctrl[:] = -0.5
        mujoco.mj_step(model, data, 2)
        states.append(np.concatenate([data.qpos, data.qvel]))
    np.testing.assert_allclose(states[1], states[0], rtol=1e-6)


def test_families_of_a_model_do_not_affect_each_other():
    """The joints are separate, so that none affects another."""
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
        single = trajectory(codrl_mj.add_motors(spec, {name: actuator}).compile(), inputs)
        for column in (index, count + index, 2 * count + index):
            np.testing.assert_array_equal(together[:, column], single[:, column])


@pytest.mark.parametrize("nthread", [1, 2])
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_a_batch_equals_a_loop(integrator, nthread):
    """Each simulation has different motors."""
    nsim, steps = 8, 60
    resistances = np.linspace(0.8, 2.0, nsim)
    actuators = [LOOP.replaced({"motor.resistance": value}) for value in resistances]
    models = [
        behind_plugin(arm(integrator), {"one": actuator, "two": ACTUATORS["lag"]})
        for actuator in actuators
    ]
    inputs = [controls(steps, 2, seed) for seed in range(nsim)]
    batch = Batch(models[0], nsim=nsim, nthread=nthread)
    batch.expand("actuator_user")[:] = [model.actuator_user for model in models]
    ctrl, qpos, state = batch.bind("ctrl"), batch.bind("qpos"), batch.bind("plugin_state")
    for step in range(steps):
        ctrl[:] = [sequence[step] for sequence in inputs]
        batch.step()
    for sim, model in enumerate(models):
        data = mujoco.MjData(model)
        trajectory(model, inputs[sim], data)
        np.testing.assert_array_equal(qpos[sim], data.qpos)
        np.testing.assert_array_equal(state[sim], data.plugin_state)
    assert len(np.unique(qpos[:, 0])) == nsim


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_a_rollout_equals_a_loop(integrator):
    model = behind_plugin(arm(integrator), {"one": NOISY, "two": ACTUATORS["torque_speed"]})
    inputs = np.array([controls(50, 2, seed) for seed in range(6)])
    start = full_state(mujoco.MjData(model))
    states, _ = rollout.rollout(model, [mujoco.MjData(model) for _ in range(2)], start, inputs)
    for sequence, final_states in zip(inputs, states, strict=True):
        data = mujoco.MjData(model)
        trajectory(model, sequence, data)
        np.testing.assert_array_equal(final_states[-1], full_state(data))


def test_motors_are_cleared_after_a_state_is_set():
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


def test_noise_depends_on_its_key():
    model = behind_plugin(arm(), {"one": NOISY, "two": NOISY})
    inputs, ends = controls(50, 2), []
    for keys in ((1, 2), (1, 2), (2, 1)):
        data = mujoco.MjData(model)
        codrl_mj.engine.clear_motors(data, keys)
        ends.append(trajectory(model, inputs, data))
    np.testing.assert_array_equal(ends[0], ends[1])
    assert not np.array_equal(ends[0], ends[2])


def test_disabled_and_enabled_actuation_is_the_same_in_both_backends():
    states = []
    for build in (behind_callback, behind_plugin):
        model = build(arm(), {"one": LOOP.replaced({"motor.arm_radius": 1.0})})

        def switch(data, model=model):
            flag = mujoco.mjtDisableBit.mjDSBL_ACTUATION
            step = round(data.time / model.opt.timestep)
            model.opt.disableflags = flag if 20 <= step < 30 else 0

        states.append(trajectory(model, controls(60, 2), before_step=switch)[:, :4])
    np.testing.assert_array_equal(*states)
