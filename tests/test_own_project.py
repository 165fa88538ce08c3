"""A project of somebody else's on every face and command, with no file of ours edited: family, task, agent, physics."""

import sys

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from safetensors.numpy import load_file

import codrl_mj
from codrl_mj.cli import main
from codrl_mj.physics.registry import PHYSICS
from codrl_mj.runs.summaries import read_run
from codrl_mj.tasks import reference_of
from tests.own_project import arm, series_elastic, slow_motion

ID, AGENT, SOFT = arm.TASK.env_id, "tests.own_project.a2c:A2CConfig", "tests.own_project.series_elastic:SOFT"
DISTURBED = {"command_delay": 0.013, "pulse_force": 0.5, "pulse_duration": 0.05, "pulse_interval": 0.2}


@pytest.fixture(autouse=True)
def _registered():
    """Task and physics are known during these tests, and to no other test."""
    codrl_mj.register(arm.TASK)
    codrl_mj.register_physics("slow_motion", slow_motion.SlowMotion)
    yield
    del PHYSICS["slow_motion"]


def actions(steps, count, seed=0):
    return np.random.default_rng(seed).uniform(-9.0, 9.0, (steps, count, 2)).astype(np.float32)


def test_the_family_runs_in_the_engine_as_in_python():
    env = gymnasium.make(ID, actuator=series_elastic.SOFT, disable_env_checker=True).unwrapped
    env.reset(seed=1)
    parameters = codrl_mj.actuators.parameters_type(series_elastic.SeriesElastic)(*series_elastic.SOFT.numbers)
    states = [series_elastic.State(0.0, 0.0)] * 2
    for action in actions(20, 1)[:, 0]:
        model, twin = env.model, gymnasium.make(ID, actuator=series_elastic.SOFT, disable_env_checker=True).unwrapped
        twin.reset(seed=1)
        twin.restore(env.snapshot())
        env.step(action)
        trace = env.physics.trace
        speeds = np.array([twin.state[2:], *trace[:-1, :, -1]])
        for row, at in zip(trace, speeds, strict=True):
            for motor in range(2):
                inputs = codrl_mj.actuators.Inputs(row[motor, 0], 0.0, at[motor], 0.0, 0.0)
                states[motor], torque, signals = series_elastic.advance(
                    parameters, model.opt.timestep, states[motor], inputs
                )
                assert (torque, *signals) == tuple(row[motor, 1:-1])


@pytest.mark.parametrize("actuator", ["ideal", "lag", SOFT, codrl_mj.Actuator()], ids=str)
def test_a_vector_of_arms_is_the_arms_alone(actuator):
    arguments = {"actuator": actuator, "disturbances": DISTURBED}
    mode = {"autoreset_mode": AutoresetMode.NEXT_STEP}
    ours = gymnasium.make_vec(ID, 3, "vector_entry_point", **arguments)
    alone = gymnasium.make_vec(ID, 3, "sync", vector_kwargs=mode, **arguments)
    np.testing.assert_array_equal(ours.reset(seed=3)[0], alone.reset(seed=3)[0])
    for action in actions(120, 3):
        (*one, infos), (*other, expected) = ours.step(action), alone.step(action)
        for mine, theirs in zip(one, other, strict=True):
            np.testing.assert_array_equal(mine, theirs)
        assert infos.keys() == expected.keys()
        for name, values in expected.items():
            np.testing.assert_array_equal(infos[name], values, err_msg=name)


def test_two_motors_have_two_forces_within_their_own_limits():
    env = gymnasium.make(ID, actuator="ideal")
    env.reset(seed=0)
    info = env.step(np.array([99.0, -99.0], np.float32))[4]
    np.testing.assert_array_equal(info["desired_force"], [8.0, -3.0])
    np.testing.assert_array_equal(info["actual_force"], [8.0, -3.0])
    each = gymnasium.make(ID, actuator=[series_elastic.SOFT, series_elastic.SeriesElastic(stiffness=80.0)])
    assert each.unwrapped.actuator[1].stiffness == 80.0
    with pytest.raises(ValueError, match="several families"):
        gymnasium.make(ID, actuator=["lag", series_elastic.SOFT])
    with pytest.raises(ValueError, match="3 actuators for the 2 motors of arm: shoulder, elbow"):
        gymnasium.make(ID, actuator=["lag"] * 3)


def test_a_task_without_a_twin_or_paper_says_so():
    with pytest.raises(ValueError, match="arm rebuilds no environment of Gymnasium's"):
        gymnasium.make(ID, actuator="lag", physics="analytic")
    with pytest.raises(ValueError, match="'weak': a variation of the paper's actuator, of which arm has none"):
        gymnasium.make(ID, actuator="weak")
    assert reference_of(arm.TASK) == "tests.own_project.arm:TASK"


def test_the_physics_is_taken_by_name_and_is_another():
    arguments = {"actuator": "lag", "disable_env_checker": True}
    slow, plain = gymnasium.make(ID, physics="slow_motion", **arguments), gymnasium.make(ID, **arguments)
    for env in (slow, plain):
        env.reset(seed=0)
        env.step(np.array([5.0, 1.0], np.float32))
    assert slow.unwrapped.data.time == plain.unwrapped.data.time / 2
    with pytest.raises(ValueError, match="physics 'mujoco' is registered already"):
        codrl_mj.register_physics("mujoco", slow_motion.SlowMotion)


def test_dm_control_has_the_arm_too():
    from codrl_mj import suite

    env = suite.load("arm", actuator=SOFT)
    single = gymnasium.make(ID, actuator=SOFT, disable_env_checker=True)
    first, (expected, _) = env.reset(), single.reset(seed=0)
    assert list(first.observation) == list(arm.TASK.observation_names)
    assert env.action_spec().shape == single.action_space.shape
    step = env.step(np.array([1.0, -1.0], np.float32))
    assert step.reward < 0.0
    assert len(step.observation) == len(expected)


def codrl(*arguments):
    assert main([str(argument) for argument in arguments]) == 0


def test_every_command_takes_the_arm(tmp_path, capsys):
    run = tmp_path / "run"
    flags = ["--agent", AGENT, "--total-steps", 320, "--num-envs", 4, "--evaluation-episodes", 2, "--seed", 5]
    codrl("train", "tests.own_project.arm:TASK", "--actuator", SOFT, *flags, "--out", run)
    assert read_run(run).state == "finished"
    weights = load_file(run / "policy.safetensors")
    again = tmp_path / "again"
    codrl("train", "tests.own_project.arm:TASK", "--actuator", SOFT, *flags, "--out", again)
    for name, values in load_file(again / "policy.safetensors").items():
        np.testing.assert_array_equal(values, weights[name])
    codrl("evaluate", run, "--trust", "--episodes", 2, "--out", tmp_path / "evaluation.json")
    codrl("render", run, "--trust", "--out", tmp_path / "film.gif", "--trajectory", tmp_path / "episode.npz")
    assert (tmp_path / "film.gif").stat().st_size > 1000
    codrl("runs", tmp_path)
    assert "arm" in capsys.readouterr().out


def test_a_run_that_names_somebodys_code_is_not_loaded_unasked(tmp_path, capsys):
    run = tmp_path / "run"
    flags = ["--agent", AGENT, "--total-steps", 32, "--num-envs", 4, "--evaluation-episodes", 1]
    codrl("train", "tests.own_project.arm:TASK", "--actuator", SOFT, *flags, "--out", run)
    assert main(["evaluate", str(run), "--episodes", "1"]) == 2
    assert "--trust" in capsys.readouterr().err
    assert "tests.own_project.arm" in sys.modules
