"""An environment's configuration: every form of it, and what is drawn at every reset, also on the command line."""

import dataclasses
import itertools
import json
import re
import shlex
from pathlib import Path

import gymnasium
import hypothesis
import numpy as np
import pytest
import yaml
from hypothesis import strategies as st

from codrl_mj import Choice, Disturbances, Joint, LogUniform, Uniform, make_sb3_vec_env, suite
from codrl_mj.actuators import CurrentLoop, DCMotorActuator, Lag, Motor, Supply, TorqueSpeed
from codrl_mj.cli import main
from codrl_mj.envs.config import EnvConfig

PAGE = (Path(__file__).parent.parent / "docs" / "randomization.md").read_text()
RANDOMIZE = {
    "controller.kp": LogUniform(0.5, 5.0),
    "motor.inductance": Uniform(0.05, 0.2),
    "controller.substeps": Choice([1, 2]),
    "controller.bemf_compensation": Choice([True, False]),
    "model.mass.pole": Uniform(0.8, 1.25),
}
WRITTEN = (
    "controller.kp=loguniform(0.5, 5.0)",
    "motor.inductance=uniform(0.05, 0.2)",
    "controller.substeps=choice(1, 2)",
    "controller.bemf_compensation=choice(True, False)",
    "model.mass.pole=uniform(0.8, 1.25)",
)


@pytest.mark.parametrize(
    "given",
    [
        RANDOMIZE,
        WRITTEN,
        list(WRITTEN),
        {name: str(distribution) for name, distribution in RANDOMIZE.items()},
        [text.replace(" ", "").replace("=", " = ") for text in WRITTEN],
    ],
    ids=["distributions", "tuple", "list", "mapping of text", "other spaces"],
)
def test_every_form_is_the_same_configuration(given):
    config = EnvConfig("cartpole", randomize=given)
    assert config.randomize == WRITTEN
    assert hash(config) == hash(EnvConfig("cartpole", randomize=RANDOMIZE))
    assert list(config.distributions.items()) == list(
        RANDOMIZE.items()
    )  # the order too: it is that of the draws
    written = json.loads(json.dumps(config.as_mapping()))
    assert (
        EnvConfig.from_mapping(written)
        == EnvConfig.from_mapping(yaml.safe_load(yaml.safe_dump(written)))
        == config
    )


def test_environments_draw_from_it():
    ours = EnvConfig("cartpole", randomize=WRITTEN).build()
    theirs = gymnasium.make("codrl_mj/CartPole-v0", randomize=RANDOMIZE)
    assert ours.reset(seed=3)[1]["randomization"] == theirs.reset(seed=3)[1]["randomization"]


def test_nothing_is_drawn_by_default():
    plain = EnvConfig("cartpole")
    assert plain.randomize is None
    assert not plain.distributions
    drawn = EnvConfig("cartpole", randomize=WRITTEN)
    assert drawn != plain
    assert dataclasses.replace(drawn, randomize=None) == plain
    assert (
        "randomize" not in drawn.policy_fields
    )  # it is no part of what an agent commands and sees


# -- every field --------------------------------------------------------------------------------------------

POSITIVE = st.floats(1e-3, 1e3)
ACTUATORS = (
    st.sampled_from(["ideal", "paper", "weaker"])
    | st.builds(Lag, POSITIVE, POSITIVE)
    | st.builds(TorqueSpeed, POSITIVE, POSITIVE, POSITIVE)
    | st.builds(
        DCMotorActuator,
        st.builds(Motor, POSITIVE),
        st.builds(CurrentLoop, kp=POSITIVE),
        st.builds(Supply, POSITIVE),
    )
)


@st.composite
def configurations(draw):
    """Configurations with any of their fields set."""
    task = draw(st.sampled_from(["pendulum", "cartpole", "acrobot", "mountain_car"]))
    fields = {
        "physics": st.sampled_from(["mujoco", "analytic"]),
        "integrator": st.sampled_from(["euler", "semi-implicit"]),
        "inner_steps": st.integers(1, 100),
        "timestep": POSITIVE,
        "action": st.sampled_from(["force", "current", "voltage"]),
        "levels": st.lists(st.floats(-10, 10), max_size=3),
        "observe_actuator": st.booleans(),
        "max_episode_steps": st.integers(1, 10_000),
        "allow_unstable": st.booleans(),
        "disturbances": st.builds(
            Disturbances, POSITIVE, POSITIVE, POSITIVE, POSITIVE, POSITIVE, POSITIVE
        ),
        "joint": st.builds(Joint, POSITIVE, POSITIVE, POSITIVE),
        "randomize": st.just(RANDOMIZE),
        **(
            {
                "options": st.fixed_dictionaries(
                    {"center_radius": POSITIVE, "sutton_barto_reward": st.booleans()}
                )
            }
            if task == "cartpole"
            else {}
        ),
    }
    return EnvConfig(task, draw(ACTUATORS), **draw(st.fixed_dictionaries({}, optional=fields)))


@hypothesis.given(configurations(), st.randoms())
def test_a_configuration_survives_json_and_keyword_arguments(config, random):
    written = json.loads(json.dumps(config.as_mapping()))
    read = EnvConfig.from_mapping(written)
    assert (read, hash(read)) == (config, hash(config))
    assert EnvConfig.from_mapping({}, config) == config
    names = random.sample(sorted(written), 5)
    part = EnvConfig.from_mapping({name: written[name] for name in ["task", *names]})
    assert (
        EnvConfig.from_mapping({name: written[name] for name in written if name not in names}, part)
        == config
    )
    arguments = {name: value for name, value in vars(config).items() if name != "joint_dynamics"}
    assert EnvConfig.of(arguments.pop("task"), None, arguments) == (config, {})


def test_every_face_is_built_from_it():
    config = EnvConfig(
        "cartpole",
        "weaker",
        inner_steps=2,
        max_episode_steps=7,
        disturbances={"command_delay": 0.02},
        joint={"friction": 0.1},
        options={"center_radius": 0.02},
    )
    single, many, theirs = config.build(), make_sb3_vec_env(config, 2), suite.load(config)
    for setup in (single.unwrapped.setup, many.env.setup, theirs.setup):
        plant = setup.simulation
        assert (plant.actuators, plant.inner_steps) == (config.actuators, 2)
        assert (plant.disturbances, plant.joint) == (config.disturbances, config.joint)
        assert setup.config.options == (0.02, False)
    assert single.spec.max_episode_steps == many.env.max_episode_steps == 7
    theirs.reset()
    assert [theirs.step(0).last() for _ in range(7)] == [False] * 6 + [True]


POLE = EnvConfig(
    "cartpole",
    "weak",
    action="voltage",
    levels=(-1, 1),
    inner_steps=3,
    integrator="semi-implicit",
    max_episode_steps=9,
    disturbances={"command_delay": 0.1},
    joint={"damping": 1.0},
    options={"center_radius": 0.3},
)
OF_ANY_TASK = {
    "action": "voltage",
    "disturbances": {"command_delay": 0.1},
    "joint": {"damping": 1.0},
}


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({"task": "cartpole"}, POLE),
        (
            {"actuator": "weaker", "disturbances": {"command_rate": 2.0}, "center_radius": 0.4},
            dataclasses.replace(
                POLE,
                actuator="weaker",
                disturbances=Disturbances(command_delay=0.1, command_rate=2.0),
                options={"center_radius": 0.4},
            ),
        ),
        # of another task, what is not given is that task's
        ({"task": "pendulum"}, EnvConfig("pendulum", "paper", **OF_ANY_TASK)),
        (
            {
                "task": "pendulum",
                "actuator": "weaker",
                "inner_steps": 2,
                "joint": {"friction": 0.5},
            },
            EnvConfig(
                "pendulum",
                "weaker",
                inner_steps=2,
                **OF_ANY_TASK | {"joint": {"damping": 1.0, "friction": 0.5}},
            ),
        ),
    ],
)
def test_fields_are_set_over_another_ones(given, expected):
    assert EnvConfig.from_mapping(given, POLE) == expected


def test_numpys_numbers_are_numbers():
    def config(number, count, flag, levels):
        return EnvConfig(
            "cartpole",
            DCMotorActuator(Motor(number(0.5))),
            inner_steps=count(4),
            action="voltage",
            levels=levels,
            observe_actuator=flag(1),
            max_episode_steps=count(7),
            disturbances={"command_delay": number(0.5)},
            joint={"damping": number(0.25)},
            options={"center_radius": number(0.5), "sutton_barto_reward": flag(1)},
        )

    given = config(np.float32, np.int64, np.bool_, np.array([-1.5, 0.0, 1.5], dtype=np.float32))
    plain = config(float, int, bool, (-1.5, 0.0, 1.5))
    assert (given, hash(given)) == (plain, hash(plain))
    assert json.dumps(given.as_mapping()) == json.dumps(plain.as_mapping())
    assert json.dumps(EnvConfig("cartpole", timestep=np.float64(0.01)).as_mapping())
    listed = EnvConfig("cartpole", action="voltage", levels=[np.float64(-1), np.int64(1)])
    assert json.dumps(listed.as_mapping()["levels"]) == "[-1.0, 1]"
    assert (
        EnvConfig("cartpole", action="voltage", levels=np.array([-1.0, 1.0])).build().action_space.n
        == 2
    )
    for number in (np.int64(0), np.float64(2.0), np.True_):
        with pytest.raises(
            ValueError, match=rf"max_episode_steps = {number.item()!r}: must be an integer >= 1"
        ):
            EnvConfig("cartpole", max_episode_steps=number)
    with pytest.raises(ValueError, match=r"center_radius = -1.0: must be a number > 0"):
        EnvConfig("cartpole", options={"center_radius": np.float32(-1.0)})


@pytest.mark.parametrize(
    ("mapping", "message"),
    [
        (
            {"task": "cartpole", "inner_step": 3},
            "unknown key env.inner_step; did you mean env.inner_steps?",
        ),
        (
            {"task": "cartpole", "center_radios": 3},
            "unknown key env.center_radios; did you mean env.center_radius?",
        ),
        (
            {"task": "pendulum", "options": {"center_radius": 3}},
            "unknown option 'center_radius' of pendulum: it has",
        ),
        ({"task": "cartpole", "center_radius": -1.0}, "center_radius = -1.0: must be a number > 0"),
        (
            {"task": "cartpole", "sutton_barto_reward": 1},
            "sutton_barto_reward = 1: must be True or False",
        ),
        ({"task": "cartpole", "center_radius": True}, "center_radius = True: must be a number > 0"),
        ({"inner_steps": 3}, "env.task: is missing"),
        ("cartpole", "env = 'cartpole': must be a mapping"),
    ],
)
def test_what_is_no_configuration_is_named(mapping, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        EnvConfig.from_mapping(mapping)


# -- the command line ---------------------------------------------------------------------------------------


def test_the_command_line_draws(tmp_path):
    def currents(*flags):
        line = [
            "render",
            "pendulum",
            "--width",
            "160",
            "--height",
            "120",
            "--env.max-episode-steps",
            "3",
        ]
        folder = tmp_path / str(len([*tmp_path.iterdir()]))
        folder.mkdir()
        files = ["--out", str(folder / "frames"), "--trajectory", str(folder / "episode.npz")]
        assert main([*line, *files, *flags]) == 0
        with np.load(folder / "episode.npz") as episode:
            return episode["trace/current"]

    drawn = [
        "--env.randomize",
        "motor.inductance=uniform(0.3, 0.6)",
        "controller.kp=loguniform(0.1,10)",
    ]
    assert not np.array_equal(currents(*drawn), currents())
    found = currents("--env.randomize", "motor.inductance=choice(0.25)")
    np.testing.assert_array_equal(found, currents("--actuator.motor.inductance", "0.25"))


@pytest.mark.parametrize(
    ("flag", "message"),
    [
        ("motor.inductance", "'motor.inductance': must be FIELD=DISTRIBUTION"),
        ("motor.inductanc=uniform(0.1,0.2)", "did you mean 'motor.inductance'?"),
    ],
)
def test_the_command_line_refuses_with_one_line(flag, message, capsys, tmp_path):
    assert (
        main(["render", "pendulum", "--out", str(tmp_path / "film.mp4"), "--env.randomize", flag])
        == 2
    )
    error = capsys.readouterr().err
    assert error.startswith("codrl-mj: error: randomize")
    assert message in error
    assert error.count("\n") == 1


def test_python_files_and_flags_of_the_page_run(capsys):
    namespace = {}
    for block in re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL):
        exec(compile(block, "randomization.md", "exec"), namespace)
    assert "rejected" in capsys.readouterr().out
    namespace["env"].close()
    files = re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)
    commands = re.findall(r"^\$ (codrl-mj (?:.*\\\n)*.*)$", PAGE, re.MULTILINE)
    assert files
    assert commands
    for content in map(yaml.safe_load, files):
        env = EnvConfig(content["task"], **content["env"]).build()
        assert env.reset(seed=0)[1]["randomization"].keys() > content["env"]["randomize"].keys()
    for command in commands:
        words = iter(shlex.split(command.replace("\\\n", "")))
        assert "--env.randomize" in words  # leaves what follows it
        config = EnvConfig(
            "cartpole",
            randomize=[*itertools.takewhile(lambda word: not word.startswith("--"), words)],
        )
        assert len(config.distributions) == 2
