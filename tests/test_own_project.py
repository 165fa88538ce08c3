"""A project of somebody else's on every face and command, with no file of ours edited: family, task, agent, physics."""

import dataclasses
import json
import math
import pickle
import subprocess
import sys

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

import codrl_mj
from codrl_mj.cli import main
from codrl_mj.envs.config import EnvConfig
from codrl_mj.physics import PHYSICS
from codrl_mj.runs.files import write_json
from codrl_mj.runs.summaries import read_run
from codrl_mj.study.advice import measurement
from codrl_mj.tasks import OURS, TASKS, find_task, reference_of
from codrl_mj.tasks.attributes import Fixed
from codrl_mj.tasks.twin import Trials
from codrl_mj.training.config import TrainConfig
from codrl_mj.validation import try_mutations, validate
from tests.matrix import but
from tests.own_project import arm, series_elastic, slow_motion
from tests.training.interruptions import TERMINATE, after, differing, outcome

ID, AGENT, SOFT = arm.TASK.env_id, "tests.own_project.a2c:A2CConfig", "tests.own_project.series_elastic:SOFT"
DISTURBED = {"command_delay": 0.013, "pulse_force": 0.5, "pulse_duration": 0.05, "pulse_interval": 0.2}


@pytest.fixture(autouse=True)
def _registered():
    """Task and physics are known during these tests, and to no other test."""
    codrl_mj.register(arm.TASK)
    codrl_mj.physics.register_physics("slow_motion", slow_motion.SlowMotion)
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


CURRENT_LOOP = codrl_mj.actuators.Actuator()


@pytest.mark.parametrize("actuator", but([SOFT, CURRENT_LOOP], ["ideal", "lag", SOFT, CURRENT_LOOP]), ids=str)
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


def test_a_variation_of_one_of_our_tasks_is_found_where_it_stands(monkeypatch):
    made = dataclasses.replace(TASKS["pendulum"], name="mine", env_id="own_project/Mine-v0")
    codrl_mj.register(made)
    assert reference_of(made) == "mine"  # it stands nowhere
    monkeypatch.setattr(slow_motion, "PENDULUM", made, raising=False)
    assert EnvConfig("mine").task == "tests.own_project.slow_motion:PENDULUM"
    assert find_task(EnvConfig("mine").task) is made
    monkeypatch.setattr(sys.modules["__main__"], "PENDULUM", made, raising=False)
    assert reference_of(made) == "tests.own_project.slow_motion:PENDULUM"
    assert [reference_of(task) for task in OURS] == [task.name for task in OURS]


def test_dm_control_lists_tasks_that_are_registered_late():
    from codrl_mj import suite

    assert ("arm", "gym") in suite.ALL_TASKS
    codrl_mj.register(dataclasses.replace(TASKS["pendulum"], name="late", env_id="own_project/Late-v0"))
    assert [domain for domain, _ in suite.ALL_TASKS] == list(TASKS)
    assert ("late", "gym") in suite.ALL_TASKS
    with pytest.raises(AttributeError, match="no attribute 'SOME_TASKS'"):
        _ = suite.SOME_TASKS


def test_the_physics_is_taken_by_name_and_is_another():
    arguments = {"actuator": "lag", "disable_env_checker": True}
    slow, plain = gymnasium.make(ID, physics="slow_motion", **arguments), gymnasium.make(ID, **arguments)
    for env in (slow, plain):
        env.reset(seed=0)
        env.step(np.array([5.0, 1.0], np.float32))
    assert slow.unwrapped.data.time == plain.unwrapped.data.time / 2
    with pytest.raises(ValueError, match="physics 'mujoco' is registered already"):
        codrl_mj.physics.register_physics("mujoco", slow_motion.SlowMotion)


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


def test_attributes_of_a_task_that_is_registered_late_are_the_models():
    env = gymnasium.make(ID, actuator="ideal", disable_env_checker=True).unwrapped
    env.reset(seed=0)
    assert (env.gravity, env.upper_mass, env.most, env.reach) == (9.81, 1.0, arm.MAX_TORQUES, 0.9)
    env.gravity, env.upper_mass = 3.7, 2.0
    assert env.model.opt.gravity[2] == -3.7
    assert env.model.body("upper").mass[0] == 2.0
    np.testing.assert_array_equal(env.model.body("upper").inertia, [0.06, 0.06, 0.002])
    with pytest.raises(AttributeError, match="several motors"):
        env.most = (9.0, 4.0)
    with pytest.raises(AttributeError, match="compiled"):
        env.reach = 1.0
    vector = gymnasium.make_vec(ID, 2, "vector_entry_point", actuator="ideal")
    vector.set_attr("upper_mass", [1.5, 2.5])
    assert vector.get_attr("upper_mass") == (1.5, 2.5)
    assert gymnasium.make("codrl_mj/CartPole-v0").unwrapped.gravity == 9.8
    assert not hasattr(gymnasium.make("codrl_mj/CartPole-v0").unwrapped, "upper_mass")


def test_a_pickled_environment_has_its_attributes_in_another_process():
    env = gymnasium.make(ID, actuator="ideal", disable_env_checker=True).unwrapped
    env.upper_mass = 2.0
    code = "import pickle, sys; print(pickle.load(sys.stdin.buffer).upper_mass)"
    done = subprocess.run([sys.executable, "-c", code], input=pickle.dumps(env), capture_output=True, timeout=120)
    assert done.stdout.strip() == b"2.0", done.stderr


def test_an_attribute_that_environments_have_already_is_refused():
    for name in ("physics", "step", "state"):
        task = dataclasses.replace(arm.TASK, name="other", env_id="own_project/Other-v0", attributes={name: Fixed(1)})
        codrl_mj.register(task)
        with pytest.raises(ValueError, match=f"'other': environments have a '{name}' of their own"):
            gymnasium.make(task.env_id, task="other", actuator="ideal")
        del TASKS["other"], gymnasium.registry[task.env_id]


def codrl(*arguments):
    assert main([str(argument) for argument in arguments]) == 0


def test_every_command_takes_the_arm_and_loads_it_when_it_is_trusted(tmp_path, capsys):
    run = tmp_path / "run"
    flags = ["--agent", AGENT, "--total-steps", 64, "--num-envs", 4, "--evaluation-episodes", 1, "--seed", 5]
    codrl("train", "tests.own_project.arm:TASK", "--actuator", SOFT, *flags, "--out", run)
    assert read_run(run).state == "finished"
    codrl("evaluate", run, "--trust", "--episodes", 2, "--out", tmp_path / "evaluation.json")
    codrl("render", run, "--trust", "--out", tmp_path / "film.gif", "--trajectory", tmp_path / "episode.npz")
    assert (tmp_path / "film.gif").stat().st_size > 1000
    codrl("runs", tmp_path)
    assert "arm" in capsys.readouterr().out
    # a run that names somebody's code is not loaded unasked
    assert main(["evaluate", str(run), "--episodes", "1"]) == 2
    assert "--trust" in capsys.readouterr().err
    assert "tests.own_project.arm" in sys.modules


def test_advice_for_a_run_of_the_arm_is_measured_when_it_is_trusted(tmp_path):
    config = TrainConfig.preset("tests.own_project.arm:TASK", AGENT, total_steps=64)
    write_json(tmp_path / "run" / "config.json", {"train": config.as_mapping()})
    with pytest.raises(ValueError, match="--trust"):
        measurement("lag", str(tmp_path / "run"), 2, tmp_path)
    assert measurement("lag", str(tmp_path / "run"), 2, tmp_path, trust=True).home.env.task == config.task


def test_a_training_of_the_arm_that_was_stopped_comes_to_the_same_weights(tmp_path):
    flags = ["--agent", AGENT, "--total-steps", 320, "--num-envs", 4, "--evaluation-episodes", 1, "--no-tensorboard"]
    line = ["train", "tests.own_project.arm:TASK", "--actuator", SOFT, *flags, "--checkpoint-interval", 64, "--out"]
    whole, stopped = tmp_path / "whole", tmp_path / "stopped"
    codrl(*line, whole)
    with after(170, TERMINATE):
        assert main([str(argument) for argument in (*line, stopped)]) != 0
    assert read_run(stopped).state == "unfinished"
    codrl("train", "--resume", stopped, "--trust")
    assert read_run(stopped).state == "finished"
    assert differing(outcome(whole), outcome(stopped)) == []


# -- the certificate ----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """What the command writes of the arm."""
    folder = tmp_path_factory.mktemp("certificate")
    codrl("validate", "tests.own_project.arm:TASK", "--quick", "--out", folder)
    return folder


@pytest.mark.matrix
def test_the_command_certifies_the_arm_and_says_what_it_left_out(written):
    content = json.loads((written / "certificate.json").read_text())
    assert (content["subject"], content["verdict"]) == ("arm", "passed")
    names = {(check["group"], check["name"]) for check in content["checks"] if check["task"] == "arm"}
    assert {("motor", f"{kind}: {motor}") for kind in ("stable", "steps") for motor in arm.TASK.motors} <= names
    assert {("convergence", f"order, rk4, {case}") for case in ("ideal actuator", "motor in the loop")} <= names
    assert {("energy", f"order, {kind} balance, rk4") for kind in ("electrical", "mechanical", "whole")} <= names
    assert {("execution", name) for name in ("batched, 2 threads", "restored", "pickled, rk4")} <= names
    reasons = {(skip["group"], skip["name"]): skip["reason"] for skip in content["skipped"] if skip["task"] == "arm"}
    assert "rebuilds no environment" in reasons["dynamics", "all checks"]
    assert "rebuilds no environment" in reasons["trajectories", "all checks"]
    assert "default current loop" in reasons["motor", "the paper's actuators"]
    page = (written / "certificate.html").read_text()
    assert all(reason.replace("'", "&#39;") in page for reason in reasons.values())


@pytest.mark.matrix
def test_python_finds_what_the_command_found(written):
    found = {check.name: check.worst for check in validate("arm", quick=True, groups=["convergence", "energy"]).checks}
    content = json.loads((written / "certificate.json").read_text())
    assert found == {
        check["name"]: check["worst"] for check in content["checks"] if check["group"] in ("convergence", "energy")
    }


@pytest.mark.matrix
def test_a_registered_task_changes_nothing_for_ours(monkeypatch):
    with monkeypatch.context() as patch:
        patch.delitem(TASKS, "arm")
        alone = validate("pendulum", quick=True, groups=["motor", "execution"]).checks
    beside = validate(["arm", "pendulum"], quick=True, groups=["motor", "execution"]).checks
    ours, expected = ([dataclasses.replace(check, plots=()) for check in checks] for checks in (beside, alone))
    assert [check for check in ours if check.task != "arm"] == expected


def test_the_arms_checks_can_fail(monkeypatch):
    """Its integrator is not the one that it names; its loop lags; a joint is damped by what nobody knows of."""
    from codrl_mj.physics import mujoco_single

    build = mujoco_single.task_model

    def wrong(*arguments, **options):
        model = build(*arguments, **options)
        model.opt.integrator = 0
        model.dof_damping[:] += 0.3
        return model

    monkeypatch.setattr(mujoco_single, "task_model", wrong)
    checks = {
        check.name: check.passed for check in validate("arm", quick=True, groups=["convergence", "energy"]).checks
    }
    assert {name for name, passed in checks.items() if not passed} == {
        "order, rk4, ideal actuator",
        "order, rk4, motor in the loop",
        "order, mechanical balance, rk4",
        "order, whole balance, rk4",
    }


def variation(**fields):
    return codrl_mj.register(dataclasses.replace(arm.TASK, name="other", env_id="own_project/Other-v0", **fields))


def skipped(groups=("convergence", "energy")):
    return [(skip.name, skip.reason) for skip in validate("other", quick=True, groups=groups).skipped]


def test_a_run_that_is_not_smooth_is_left_out_and_said():
    variation(constrain=lambda state, _: (state[0], state[1], np.minimum(state[2], 0.5), state[3]))
    for name, reason in skipped():
        assert name in ("all checks", "the balances of a whole run")
        assert "meets the task's bounds: name another in Task.trials" in reason


def test_a_hill_without_a_twin_has_no_ledger_and_says_so():
    car = TASKS["mountain_car"]
    codrl_mj.register(dataclasses.replace(car, name="other", env_id="own_project/Other-v0", twin=None, paper=()))
    assert skipped(["energy"]) == [("all checks", "its model has a hill, whose height only a twin knows")]


def test_a_run_of_ones_own_is_taken():
    trials = Trials((math.pi,) * 4, ((0.0,),) * 4, start=(0.3, 0.1, 0.0, 0.0), steps=4, balanced_steps=2)
    variation(trials=trials)
    result = validate("other", quick=True, groups=["convergence"])
    assert [skip.name for skip in result.skipped] == ["equations of motion that are not MuJoCo's"]
    assert len(result.checks) == 3


class Swing:
    """Drives the pendulum's twin by a name of its own."""

    def __new__(cls):
        return TASKS["pendulum"].twin()


def test_a_twin_without_paper_or_states_is_compared_where_it_can_be():
    pendulum = dataclasses.replace(
        TASKS["pendulum"], name="other", env_id="own_project/Other-v0", twin=Swing, paper=(), trials=None
    )
    codrl_mj.register(pendulum)
    result = validate("other", quick=True, groups=["dynamics", "trajectories"])
    assert result.passed
    assert {check.name for check in result.checks} == {
        "run, semi-implicit, ideal actuator",
        "run against rounding, semi-implicit, ideal actuator",
    }
    assert [(skip.group, skip.name) for skip in result.skipped] == [
        ("dynamics", "all checks"),
        ("trajectories", "runs with the paper, weaker, starved actuators"),
        ("trajectories", "a run with an off-the-shelf motor"),
    ]


def test_faults_are_made_in_our_own_tasks_alone(capsys):
    with pytest.raises(ValueError, match="'arm': faults are made in these alone: pendulum"):
        try_mutations("arm")
    assert main(["validate", "tests.own_project.arm:TASK", "--mutations"]) == 2
    assert "faults are made in these alone" in capsys.readouterr().err
