"""A run's report: it has what a run has, says what it lacks, and stays small."""

import base64
import dataclasses
import json
import re
import shutil
from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from codrl_mj.actuators import Drive, Lag, SampledLoop
from codrl_mj.cli import main
from codrl_mj.envs.config import EnvConfig
from codrl_mj.evaluation import RandomPolicy, run_episodes
from codrl_mj.physics.offscreen import RenderingUnavailableError
from codrl_mj.runs.policies import load_policy
from codrl_mj.sizing import find_drive
from codrl_mj.training import load_config
from codrl_mj.viz.pages import episode as episodes
from codrl_mj.viz.pages import report as reports
from codrl_mj.viz.pages.diagrams import held_step
from codrl_mj.viz.pages.episode import Shown, episode_section, show
from codrl_mj.viz.pages.report import report
from tests.viz.pages.parsed import Parsed, check_alone

RUNS = Path(__file__).parents[1] / "fixtures" / "runs"
PENDULUM = RUNS / "pendulum"
MEDIAN = 1_000_001
"""Seed of the lower of the two returns of its evaluation, of the seeds 1000000 and 1000001."""


@pytest.fixture(scope="module")
def text(tmp_path_factory):
    """The report of a finished run, by the command."""
    out = tmp_path_factory.mktemp("report") / "report.html"
    assert main(["report", str(PENDULUM), "--out", str(out)]) == 0
    return out.read_text()


def curves(text, title):
    """Labels and arrays of a plot's curves."""
    (found,) = (data for data in check_alone(text).data if data["title"] == title)
    arrays = [np.frombuffer(base64.b64decode(one), "<f4") for one in found["arrays"]]
    return {one["label"]: (arrays[one["x"]], arrays[one["y"]]) for one in found["curves"]}


def test_a_report_is_one_small_file_with_every_section(text):
    parsed = check_alone(text)
    assert {"learning", "evaluation", "episode", "loop", "settings"} <= set(parsed.ids)
    assert len(text) < 5_000_000
    assert f"seed {MEDIAN}" in parsed.text
    video = re.search(r'src="data:video/mp4;base64,([^"]+)"', text)[1]
    assert base64.b64decode(video[:64])[4:8] == b"ftyp"


def test_the_plots_show_the_episode_that_the_film_shows(text):
    """The oracle: the same episode, run anew."""
    (episode,) = run_episodes(
        load_policy(PENDULUM), load_config(PENDULUM).evaluation_env.make, 1, MEDIAN
    )
    drawn = curves(text, "Torque at the shaft")
    arm = episode.actuator.arm_radius
    np.testing.assert_allclose(
        drawn["actual"][1][:-1], episode.trace["actual_force"] * arm, rtol=1e-6
    )
    steps = np.repeat(episode.signals["desired_force"], episode.inner_steps) * arm
    np.testing.assert_allclose(drawn["desired"][1][:-1], steps, rtol=1e-6)
    error = curves(text, "Error: desired less actual")["desired less actual"][1][:-1]
    np.testing.assert_allclose(error, steps - episode.trace["actual_force"] * arm, atol=1e-6)
    reward = curves(text, "Reward of each step")["reward"]
    np.testing.assert_allclose(reward[1][:-1], episode.reward, rtol=1e-6)
    assert reward[0][-1] == pytest.approx(episode.time[-1])
    current, voltage = (episode.trace[name] for name in ("current", "voltage"))
    power = curves(text, "Power and losses")
    np.testing.assert_allclose(power["electrical"][1][:-1], current * voltage, rtol=1e-5, atol=1e-9)
    (transport,) = re.findall(r'type="range" min="0" max="([^"]+)"', text)
    assert float(transport) == pytest.approx(episode.time[-1])


def test_the_papers_current_loop_has_its_margins_and_its_step(text):
    parsed = check_alone(text)
    titles = {data["title"] for data in parsed.data}
    assert {"Bode: gain", "Bode: phase", "A small step of the current, the shaft held"} <= titles
    assert "phase margin" in parsed.text
    assert f"seed {MEDIAN}" in parsed.text.partition("An episode")[2]


def test_it_says_which_loops_it_leaves_out_and_why_there_is_none():
    def run(actuators):
        return Shown("run", SimpleNamespace(driven=actuators), None, None, None, 0)

    drives = {
        f"m{place}": find_drive("maxon-dcx22l", bandwidth=300.0 + place) for place in range(6)
    }
    assert "The first 4 of 6 different loops are shown; not those of m4, m5" in str(
        reports._loop([run(drives)])
    )
    said = str(reports._loop([run({"lag": Lag(time_constant=0.1)})]))
    assert "lag: The delivered torque follows the desired one with a time constant" in said
    assert "There is no current loop in it." in said
    assert "m: assumed, because not specified: supply.voltage = 24 V" in str(
        reports._loop([run({"m": Drive()})])
    )


@pytest.fixture
def run(tmp_path):
    """A copy of a finished run."""
    return shutil.copytree(PENDULUM, tmp_path / "a<b> & run")


def of(*runs, **options):
    """The page of runs, read."""
    return check_alone(
        report(runs, runs[-1].with_name("r.html"), filmed=False, **options).read_text()
    )


def test_without_opengl_there_is_no_film_and_everything_else(tmp_path, monkeypatch):
    def no_film(*_, **__):
        raise RenderingUnavailableError("cannot make an OpenGL context: none here")

    monkeypatch.setattr(episodes, "clip", no_film)
    text = report([PENDULUM], tmp_path / "r.html").read_text()
    parsed = check_alone(text)
    assert (
        "No film of pendulum: RenderingUnavailableError: cannot make an OpenGL context"
        in parsed.text
    )
    assert "<video" not in text
    assert len(parsed.data) > 8


def evaluated(run, returns, folder="."):
    """Write an evaluation with these returns into a run."""
    content = json.loads((PENDULUM / "evaluation.json").read_text())
    content.pop("sha256", None)
    conditions = {"env": load_config(PENDULUM).env.as_mapping(), "seed": 1_000_000}
    changed = content | {"episode_returns": returns, "conditions": conditions}
    (run / folder / "evaluation.json").write_text(json.dumps(changed))


def test_the_episode_is_the_median_one_of_the_evaluation_or_says_how_rare_it_is(run):
    evaluated(run, [-900.0, -200.0, -1500.0, -300.0, -1000.0])
    assert "seed 1000000, return" in of(run).text  # the median, -900
    text = of(run, seed=7).text
    (episode,) = run_episodes(load_policy(run), load_config(run).evaluation_env.make, 1, 7)
    worse = sum(one < episode.total for one in (-900.0, -200.0, -1500.0, -300.0, -1000.0))
    assert "seed 7, return" in text
    assert f"of 5 evaluated episodes {worse} returned less, the median -900 (seed 1000000)" in text
    evaluated(run, [])
    assert "seed 0, return" in of(run).text
    assert "evaluated episodes" not in of(run).text


def test_of_the_best_policy_it_is_the_median_of_its_own_evaluation(run, capsys):
    (run / "best").mkdir()
    for name in ("policy.json", "policy.safetensors"):
        shutil.copy(PENDULUM / name, run / "best")
    evaluated(run, [-1.0, -2.0, -3.0], "best")
    assert "seed 1000001, return" in of(run, which="best").text
    evaluated(run, [-7.0, -8.0, -9.0])
    for which, median in (("best", "-2 (seed 1000001)"), ("last", "-8 (seed 1000001)")):
        assert main(["replay", str(run), "--which", which, "--out", str(run / "r.html")]) == 0
        assert f"returned less, the median {median}" in capsys.readouterr().out
    assert main(["replay", str(run), "--actuator", "weaker", "--out", str(run / "r.html")]) == 0
    assert "evaluated" not in capsys.readouterr().out  # another environment


def test_an_unfinished_run_says_so_and_shows_what_there_is(run):
    for name in ("result.json", "evaluation.json", "policy.json", "policy.safetensors"):
        (run / name).unlink()
    parsed = of(run)
    assert "The training is not finished" in parsed.text
    assert "No episode of a<b> & run: the run has no policy yet" in parsed.text
    assert "a<b> & run has no evaluation" in parsed.text
    assert "Return while learning" in parsed.text
    (run / "best").mkdir()
    for name in ("policy.json", "policy.safetensors"):
        shutil.copy(PENDULUM / name, run / "best")
    assert "the policy of its best evaluation acts" in of(run).text


def test_a_damaged_run_says_what_is_damaged(run):
    for name in ("evaluation.json", "certificate.json"):
        (run / name).write_text("{")
    content = json.loads((run / "config.json").read_text())
    content["train"]["agent"]["learning_rate"] = "nonsense"
    (run / "config.json").write_text(json.dumps(content))
    parsed = of(run)
    assert "The run folder is damaged" in parsed.text
    assert "evaluation.json is not a policy evaluation: it is truncated" in parsed.text
    assert "certificate.json is no certificate" in parsed.text
    assert "No episode of a<b> & run" in parsed.text


def test_several_runs_stand_side_by_side(run):
    checks = [{"group": "motor", "passed": True}]
    certificate = {
        "verdict": "passed",
        "subject": "pendulum",
        "made": "then",
        "quick": True,
        "checks": checks,
    }
    (run / "certificate.json").write_text(json.dumps(certificate))
    text = report([PENDULUM, run], run.with_name("r.html"), filmed=False).read_text()
    parsed = check_alone(text)
    assert {"pendulum: actual", "a<b> & run: actual"} <= curves(text, "Torque at the shaft").keys()
    assert text.count('name="show-run"') == 2
    assert "passed: 1 of 1 checks" in parsed.text
    assert "What differs between the runs" in parsed.text


def motors_of(section):
    """Labels and tags of the curves of torque."""
    torque = next(data for data in Parsed(section).data if data["title"] == "Torque at the shaft")
    return [(one["label"], one["tags"][1]) for one in torque["curves"]]


def test_several_motors_can_be_chosen():
    env = load_config(PENDULUM).evaluation_env
    (one,) = run_episodes(load_policy(PENDULUM), env.make, 1, 0)
    arrays = {
        field: {
            name: np.stack([values, 2.0 * values], axis=1)
            for name, values in getattr(one, field).items()
        }
        for field in ("trace", "signals")
    }
    arrays |= {"first_speeds": np.repeat(one.first_speeds, 2)}
    two = dataclasses.replace(one, actuator=(one.actuator,) * 2, motors=("left", "right"), **arrays)
    section = str(episode_section([Shown("arm", env, two, None, "none was asked for", 0)]))
    assert motors_of(section) == [
        (f"{side}: {what}", f"motor:{place}")
        for place, side in enumerate(two.motors)
        for what in ("actual", "desired")
    ]
    assert section.count('name="show-motor"') == 2
    assert "No film of arm: none was asked for" in Parsed(section).text


def test_an_ideal_actuator_beside_a_motor_has_a_force():
    envs = (EnvConfig("pendulum", name, max_episode_steps=2) for name in ("weak", "ideal"))
    shown = [
        show(env.actuator.family, env, RandomPolicy("pendulum"), 0, filmed=False) for env in envs
    ]
    labels = {one["title"]: one["y"]["label"] for one in Parsed(str(episode_section(shown))).data}
    assert labels["Torque at the shaft"] == "torque [N·m], of the ideal actuator force [N]"
    alone = Parsed(str(episode_section(shown[1:]))).data
    assert "Force" in [one["title"] for one in alone]


def test_a_plot_is_shaded_where_its_own_limit_is_met():
    geared = find_drive("maxon-ec45-flat-50w", gear_ratio=20.0)
    drive = dataclasses.replace(geared, controller=SampledLoop(max_current=0.1))
    env = EnvConfig("pendulum", drive, max_episode_steps=10)
    section = str(
        episode_section([show("limited", env, RandomPolicy("pendulum"), 0, filmed=False)])
    )
    met = {
        one["title"]: {
            shade["label"]: len(one["arrays"][shade["spans"]]) for shade in one["shades"]
        }
        for one in Parsed(section).data
    }
    assert list(met["Torque at the shaft"]) == ["saturated"]
    assert list(met["Current and its reference"]) == ["current saturated", "temperature saturated"]
    assert met["Voltage and its limit"] == {"voltage saturated": 0}
    assert met["Current and its reference"]["current saturated"] > 0


def test_states_of_every_kind_of_joint_have_units(monkeypatch):
    """The oracle: three metres and a quaternion, a quaternion, a metre, a radian; and what they are in a second."""
    bodies = "".join(
        f'<body><joint type="{kind}"/><geom size=".1"/></body>'
        for kind in ("ball", "slide", "hinge")
    )
    bodies += "<body><freejoint/><geom size='.1'/></body>"
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")
    made = SimpleNamespace(unwrapped=SimpleNamespace(model=model), close=lambda: None)
    monkeypatch.setattr(EnvConfig, "make", lambda _: made)
    names = EnvConfig("Ant-v5").world.state_names(EnvConfig("Ant-v5"))
    units = [re.search(r"\[(.*)\]", name)[1] for name in names]
    assert units[: model.nq] == ["1"] * 4 + ["m", "rad"] + ["m"] * 3 + ["1"] * 4
    assert units[model.nq :] == ["rad/s"] * 3 + ["m/s", "rad/s"] + ["m/s"] * 3 + ["rad/s"] * 3


def test_a_step_is_at_each_actuators_own_steps():
    """The oracle: a lag that is exact between its steps approaches 1 as 1 - exp(-t/T)."""
    lag = Lag(time_constant=0.05)
    plot = held_step({"slow": (lag, 2.0, 0.02), "fast": (lag, 1.0, 0.01)})
    slow, fast, asked = plot.curves
    for curve, step in ((slow, 0.02), (fast, 0.01)):
        assert f"steps of {1e3 * step:g} ms" in curve.label
        np.testing.assert_allclose(np.diff(curve.x), step)
        np.testing.assert_allclose(curve.y, 1.0 - np.exp(-curve.x / 0.05), atol=1e-12)
    assert asked.x[-1] == max(slow.x[-1], fast.x[-1])


@pytest.mark.matrix
def test_motors_of_somebody_elses_robot_are_filmed():
    env = EnvConfig(
        "Reacher-v5", {"joint0": "maxon-ec45-flat-50w", "joint1": "quanser-qube-servo-2"}
    )
    shown = show("reacher", env, RandomPolicy(env.make().action_space), 0)
    assert shown.problem is None
    assert 1.0 / shown.episode.time[0] == pytest.approx(50.0)
    assert shown.film.rate == pytest.approx(
        25.0
    )  # every second: more than 30 a second are not shown
    section = str(episode_section([shown]))
    assert [tag for _, tag in motors_of(section)] == ["motor:0", "motor:0", "motor:1", "motor:1"]
    assert "State: target x, target y" in Parsed(section).text


@pytest.mark.parametrize(
    ("runs", "out", "options", "message"),
    [
        ([], "r.html", {}, "runs: none was given"),
        ([PENDULUM], "r.html", {"seed": -1}, "seed = -1: must be >= 0"),
        ([PENDULUM], "r.pdf", {}, r"must be \.html"),
        (
            [PENDULUM],
            "r.html",
            {"certificate": Path("certificate.json")},
            "is no certificate: KeyError: 'checks'",
        ),
        ([Path("nowhere")], "r.html", {}, "no run at"),
    ],
)
def test_bad_input_is_refused_before_anything_is_run(
    tmp_path, monkeypatch, runs, out, options, message
):
    monkeypatch.chdir(tmp_path)
    Path("certificate.json").write_text("{}")
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        report(runs, Path(out), **options)
    assert [path.name for path in tmp_path.iterdir()] == ["certificate.json"]
