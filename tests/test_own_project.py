"""A custom project with family, task, agent and physics works with all interfaces and commands."""

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
from codrl_mj.study.advice import plan_measurement
from codrl_mj.tasks import PAPER_TASKS, TASKS, find_task, reference_of
from codrl_mj.tasks.attributes import Fixed
from codrl_mj.tasks.reference_env import ReferenceStates
from codrl_mj.training import TrainConfig, load_config
from codrl_mj.validation import try_mutations, validate
from tests.matrix import matrix_params
from tests.own_project import arm, series_elastic, slow_motion
from tests.training.interruptions import TERMINATE, after, differing, outcome

ID, AGENT, SOFT = (
    arm.TASK.env_id,
    "tests.own_project.a2c:A2CConfig",
    "tests.own_project.series_elastic:SOFT",
)
DISTURBED = {
    "command_delay": 0.013,
    "pulse_force": 0.5,
    "pulse_duration": 0.05,
    "pulse_interval": 0.2,
}


@pytest.fixture(autouse=True)
def _registered():
    """Register task and physics for these tests only."""
    codrl_mj.register(arm.TASK)
    codrl_mj.physics.register_physics("slow_motion", slow_motion.SlowMotion)
    yield
    del PHYSICS["slow_motion"]


def actions(steps, count, seed=0):
    return np.random.default_rng(seed).uniform(-9.0, 9.0, (steps, count, 2)).astype(np.float32)


def make_arm(actuator="ideal", **arguments):
    """Make the arm, and reset it."""
    env = gymnasium.make(ID, actuator=actuator, disable_env_checker=True, **arguments).unwrapped
    env.reset(seed=0)
    return env


def register_variation(task=arm.TASK, **fields):
    """Register a variation of a task as another task."""
    return codrl_mj.register(
        dataclasses.replace(task, name="other", env_id="own_project/Other-v0", **fields)
    )


def test_the_family_runs_in_the_engine_as_in_python():
    env = make_arm(series_elastic.SOFT)
    parameters = codrl_mj.actuators.parameters_type(series_elastic.SeriesElastic)(
        *series_elastic.SOFT.parameter_values
    )
    states = [series_elastic.State(0.0, 0.0)] * 2
    for action in actions(20, 1)[:, 0]:
        before = env.state[2:]
        env.step(action)
        trace = env.physics.trace
        for row, speeds in zip(trace, [before, *trace[:-1, :, -1]], strict=True):
            for motor in range(2):
                inputs = codrl_mj.actuators.Inputs(row[motor, 0], 0.0, speeds[motor], 0.0, 0.0)
                advance_arguments = parameters, env.model.opt.timestep, states[motor], inputs
                states[motor], torque, signals = series_elastic.advance(*advance_arguments)
                assert (torque, *signals) == tuple(row[motor, 1:-1])


CURRENT_LOOP = codrl_mj.actuators.DCMotorActuator()


@pytest.mark.parametrize(
    "actuator", matrix_params([SOFT, CURRENT_LOOP], ["ideal", "lag", SOFT, CURRENT_LOOP]), ids=str
)
def test_a_vector_of_arms_equals_single_arms(actuator):
    arguments = {"actuator": actuator, "disturbances": DISTURBED}
    mode = {"autoreset_mode": AutoresetMode.NEXT_STEP}
    ours = gymnasium.make_vec(ID, 3, "vector_entry_point", **arguments)
    serial = gymnasium.make_vec(ID, 3, "sync", vector_kwargs=mode, **arguments)
    np.testing.assert_array_equal(ours.reset(seed=3)[0], serial.reset(seed=3)[0])
    for action in actions(120, 3):
        np.testing.assert_equal(ours.step(action), serial.step(action))


def test_two_motors_have_two_forces_within_their_own_limits():
    info = make_arm().step(np.array([99.0, -99.0], np.float32))[4]
    for force in ("desired_force", "actual_force"):
        np.testing.assert_array_equal(info[force], [8.0, -3.0])
    assert (
        make_arm([series_elastic.SOFT, series_elastic.SeriesElastic(stiffness=80.0)])
        .actuator[1]
        .stiffness
        == 80.0
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"actuator": ["lag", series_elastic.SOFT]}, "several families"),
        ({"actuator": ["lag"] * 3}, r"3 actuators, but arm has 2 motors \(shoulder, elbow\)"),
        ({"actuator": "lag", "physics": "analytic"}, "arm has no Task.reference_env"),
        (
            {"actuator": "weak"},
            "'weak': is a variation of the paper's actuator, but arm has no such actuator",
        ),
    ],
)
def test_raises_for_what_the_arm_does_not_have(arguments, message):
    with pytest.raises(ValueError, match=message):
        gymnasium.make(ID, **arguments)


def test_a_variation_of_a_built_in_task_is_found_by_its_module(monkeypatch):
    variation, reference = (
        register_variation(TASKS["pendulum"]),
        "tests.own_project.slow_motion:PENDULUM",
    )
    # No module has an attribute with this task.
    assert reference_of(variation) == "other"
    monkeypatch.setattr(slow_motion, "PENDULUM", variation, raising=False)
    assert EnvConfig("other").task == reference
    assert find_task(reference) is variation
    monkeypatch.setattr(sys.modules["__main__"], "PENDULUM", variation, raising=False)
    assert reference_of(variation) == reference
    assert reference_of(arm.TASK) == "tests.own_project.arm:TASK"
    assert [reference_of(task) for task in PAPER_TASKS] == [task.name for task in PAPER_TASKS]


def test_dm_control_lists_and_loads_custom_tasks():
    from codrl_mj import suite

    register_variation(TASKS["pendulum"])
    assert tuple((domain, "gym") for domain in TASKS) == suite.ALL_TASKS
    assert {"arm", "other"} < TASKS.keys()
    with pytest.raises(AttributeError, match="no attribute 'SOME_TASKS'"):
        _ = suite.SOME_TASKS
    env, single = suite.load("arm", actuator=SOFT), make_arm(SOFT)
    assert list(env.reset().observation) == list(arm.TASK.observation_names)
    assert env.action_spec().shape == single.action_space.shape
    step = env.step(np.array([1.0, -1.0], np.float32))
    assert step.reward < 0.0
    assert len(step.observation) == len(single.reset()[0])


def test_a_custom_physics_is_selected_by_its_name():
    slow, normal = make_arm("lag", physics="slow_motion"), make_arm("lag")
    for env in (slow, normal):
        env.step(np.array([5.0, 1.0], np.float32))
    assert slow.data.time == normal.data.time / 2
    with pytest.raises(ValueError, match="physics 'mujoco' is registered already"):
        codrl_mj.physics.register_physics("mujoco", slow_motion.SlowMotion)


def test_attributes_of_a_custom_task_read_and_write_its_model():
    env = make_arm()
    assert (env.gravity, env.upper_mass, env.largest_torques, env.reach) == (
        9.81,
        1.0,
        arm.MAX_TORQUES,
        0.9,
    )
    env.gravity, env.upper_mass = 3.7, 2.0
    assert env.model.opt.gravity[2] == -3.7
    assert env.model.body("upper").mass[0] == 2.0
    np.testing.assert_array_equal(env.model.body("upper").inertia, [0.06, 0.06, 0.002])
    with pytest.raises(AttributeError, match="only be written in an environment with one motor"):
        env.largest_torques = (9.0, 4.0)
    with pytest.raises(AttributeError, match="compiled"):
        env.reach = 1.0
    vector = gymnasium.make_vec(ID, 2, "vector_entry_point", actuator="ideal")
    vector.set_attr("upper_mass", [1.5, 2.5])
    assert vector.get_attr("upper_mass") == (1.5, 2.5)
    cartpole = gymnasium.make("codrl_mj/CartPole-v0").unwrapped
    assert cartpole.gravity == 9.8
    assert not hasattr(cartpole, "upper_mass")
    # The attributes must also exist in another process.
    code = "import pickle, sys; print(pickle.load(sys.stdin.buffer).upper_mass)"
    process = subprocess.run(
        [sys.executable, "-c", code], input=pickle.dumps(env), capture_output=True, timeout=120
    )
    assert process.stdout.strip() == b"2.0", process.stderr


@pytest.mark.parametrize("name", ["physics", "step", "state"])
def test_raises_for_an_attribute_that_environments_already_have(name):
    task = register_variation(attributes={name: Fixed(1)})
    with pytest.raises(ValueError, match=f"'other': environments have a '{name}' of their own"):
        gymnasium.make(task.env_id, task="other", actuator="ideal")


TASK = "tests.own_project.arm:TASK"


def codrl(line):
    assert main(line.split()) == 0


def test_all_commands_accept_the_arm_and_load_it_only_with_trust(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    flags = (
        "--agent.rollout-steps 16 --total-steps 64 --num-envs 4 --evaluation-episodes 1"
        " --env.effort-weight 0.1"
    )
    codrl(f"train {TASK} --actuator {SOFT} --agent {AGENT} {flags} --out run")
    assert read_run(tmp_path / "run").state == "finished"
    config = load_config(tmp_path / "run", trust=True)
    assert (config.task, config.agent.rollout_steps, config.env.options.effort_weight) == (
        TASK,
        16,
        0.1,
    )
    assert config.actuator == (series_elastic.SOFT,) * 2
    codrl("evaluate run --trust --episodes 2 --env.effort-weight 0.2 --out evaluation.json")
    codrl("render run --trust --out film.gif --trajectory episode.npz")
    assert (tmp_path / "film.gif").stat().st_size > 1000
    codrl(
        f"render {TASK} --actuator lag --env.effort-weight 0.2 --env.max-episode-steps 2 --out"
        " film.gif"
    )
    codrl("runs .")
    assert "arm" in capsys.readouterr().out
    # A user's code must not be loaded without --trust.
    assert main(["evaluate", "run", "--episodes", "1"]) == 2
    assert "--trust" in capsys.readouterr().err


def test_advice_for_a_run_of_the_arm_is_measured_only_with_trust(tmp_path):
    config = TrainConfig.preset(TASK, AGENT, total_steps=64)
    write_json(tmp_path / "run" / "config.json", {"train": config.as_mapping()})
    with pytest.raises(ValueError, match="--trust"):
        plan_measurement("lag", str(tmp_path / "run"), 2, tmp_path)
    assert (
        plan_measurement("lag", str(tmp_path / "run"), 2, tmp_path, trust=True).baseline.env.task
        == config.task
    )


def test_a_resumed_training_of_the_arm_gives_the_same_weights(tmp_path):
    flags = (
        "--total-steps 320 --num-envs 4 --evaluation-episodes 1 --no-tensorboard"
        " --checkpoint-interval 64"
    )
    line = f"train {TASK} --actuator {SOFT} --agent {AGENT} {flags} --out {tmp_path}"
    codrl(f"{line}/whole")
    stopped = tmp_path / "stopped"
    with after(170, TERMINATE):
        assert main(f"{line}/stopped".split()) != 0
    assert read_run(stopped).state == "unfinished"
    codrl(f"train --resume {stopped} --trust")
    assert read_run(stopped).state == "finished"
    assert differing(outcome(tmp_path / "whole"), outcome(stopped)) == []


# -- the certificate ------------------------------------------------------------------------------


@pytest.mark.matrix
def test_the_command_certifies_the_arm_as_python_does_and_lists_skipped_checks(tmp_path):
    codrl(f"validate {TASK} --quick --out {tmp_path}")
    content = json.loads((tmp_path / "certificate.json").read_text())
    assert (content["subject"], content["verdict"]) == ("arm", "passed")
    names = {
        (check["group"], check["name"]) for check in content["checks"] if check["task"] == "arm"
    }
    assert {
        ("motor", f"{kind}: {motor}") for kind in ("stable", "steps") for motor in arm.TASK.motors
    } <= names
    assert {
        ("convergence", f"order, rk4, {case}") for case in ("ideal actuator", "motor in the loop")
    } <= names
    assert {
        ("energy", f"order, {kind} balance, rk4") for kind in ("electrical", "mechanical", "whole")
    } <= names
    assert {
        ("execution", name) for name in ("batched, 2 threads", "restored", "pickled, rk4")
    } <= names
    reasons = {
        (skip["group"], skip["name"]): skip["reason"]
        for skip in content["skipped"]
        if skip["task"] == "arm"
    }
    assert "no reference environment" in reasons["dynamics", "all checks"]
    assert "no reference environment" in reasons["trajectories", "all checks"]
    assert "default current loop" in reasons["motor", "the paper's actuators"]
    worst_values = {
        check.name: check.worst
        for check in validate("arm", quick=True, groups=["convergence", "energy"]).checks
    }
    certified_checks = [
        check for check in content["checks"] if check["group"] in ("convergence", "energy")
    ]
    assert worst_values == {check["name"]: check["worst"] for check in certified_checks}
    page = (tmp_path / "certificate.html").read_text()
    assert all(reason.replace("'", "&#39;") in page for reason in reasons.values())


@pytest.mark.matrix
def test_a_registered_task_does_not_change_the_checks_of_built_in_tasks(monkeypatch):
    with monkeypatch.context() as patch:
        patch.delitem(TASKS, "arm")
        checks_alone = validate("pendulum", quick=True, groups=["motor", "execution"]).checks
    checks_beside = validate(["arm", "pendulum"], quick=True, groups=["motor", "execution"]).checks
    ours, expected = (
        [dataclasses.replace(check, plots=()) for check in checks]
        for checks in (checks_beside, checks_alone)
    )
    assert [check for check in ours if check.task != "arm"] == expected


def test_the_arms_checks_can_fail(monkeypatch):
    """Use a model with another integrator and with joint damping that the checks do not know."""
    from codrl_mj.physics import mujoco_single

    build = mujoco_single.task_model

    def wrong_model(*arguments, **options):
        model = build(*arguments, **options)
        model.opt.integrator = 0
        model.dof_damping[:] += 0.3
        return model

    monkeypatch.setattr(mujoco_single, "task_model", wrong_model)
    checks = validate("arm", quick=True, groups=["convergence", "energy"]).checks
    assert {check.name for check in checks if not check.passed} == {
        "order, rk4, ideal actuator",
        "order, rk4, motor in the loop",
        "order, mechanical balance, rk4",
        "order, whole balance, rk4",
    }


def skipped_checks(groups=("convergence", "energy")):
    return [
        (skip.name, skip.reason) for skip in validate("other", quick=True, groups=groups).skipped
    ]


def test_a_run_that_is_not_smooth_is_skipped_with_a_reason():
    register_variation(
        constrain=lambda state, _: (state[0], state[1], np.minimum(state[2], 0.5), state[3])
    )
    for name, reason in skipped_checks():
        assert name in ("all checks", "the balances of a whole run")
        assert "meets the task's bounds: name another run in Task.reference_states" in reason


def test_a_hill_without_a_reference_environment_skips_the_energy_checks():
    register_variation(TASKS["mountain_car"], reference_env=None, paper=())
    assert skipped_checks(["energy"]) == [
        (
            "all checks",
            "the model has a hill, whose height can only be read from a reference environment",
        )
    ]


def test_custom_reference_states_are_used():
    trials = ReferenceStates(
        (math.pi,) * 4, ((0.0,),) * 4, start=(0.3, 0.1, 0.0, 0.0), steps=4, balanced_steps=2
    )
    register_variation(reference_states=trials)
    result = validate("other", quick=True, groups=["convergence"])
    assert [skip.name for skip in result.skipped] == ["equations of motion that are not MuJoCo's"]
    assert len(result.checks) == 3


class Swing:
    """Reference environment of the pendulum under another name."""

    def __new__(cls):
        return TASKS["pendulum"].reference_env()


def test_a_reference_environment_without_states_is_compared_as_far_as_possible():
    register_variation(TASKS["pendulum"], reference_env=Swing, paper=(), reference_states=None)
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


def test_faults_can_only_be_injected_into_built_in_tasks(capsys):
    with pytest.raises(ValueError, match="'arm': faults are made only in pendulum"):
        try_mutations("arm")
    assert main(["validate", TASK, "--mutations"]) == 2
    assert "faults are made only in" in capsys.readouterr().err
