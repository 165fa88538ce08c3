"""Report of a run: it has all sections, names what is missing, and stays small."""

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
from codrl_mj.viz.pages.diagrams import torque_step_plot
from codrl_mj.viz.pages.episode import RunEpisode, episode_section, run_and_film
from codrl_mj.viz.pages.report import report
from codrl_mj.viz.scene import state_names
from tests.viz.pages.parsed import ParsedPage, check_self_contained

RUNS = Path(__file__).parents[2] / "fixtures" / "runs"
PENDULUM = RUNS / "pendulum"
MEDIAN = 1_000_001
"""Seed of the lower of the two returns of the evaluation, with the seeds 1000000 and 1000001."""


@pytest.fixture(scope="module")
def text(tmp_path_factory):
    """Return the report of a finished run, written by the command."""
    out = tmp_path_factory.mktemp("report") / "report.html"
    assert main(["report", str(PENDULUM), "--out", str(out)]) == 0
    return out.read_text()


def curves(text, title):
    """Return the labels and arrays of a plot's curves."""
    (plot,) = (data for data in check_self_contained(text).data if data["title"] == title)
    arrays = [np.frombuffer(base64.b64decode(array), "<f4") for array in plot["arrays"]]
    return {curve["label"]: (arrays[curve["x"]], arrays[curve["y"]]) for curve in plot["curves"]}


def test_a_report_is_one_small_file_with_every_section(text):
    parsed = check_self_contained(text)
    assert {"learning", "evaluation", "episode", "loop", "settings"} <= set(parsed.ids)
    assert len(text) < 5_000_000
    assert f"seed {MEDIAN}" in parsed.text
    video = re.search(r'src="data:video/mp4;base64,([^"]+)"', text)[1]
    assert base64.b64decode(video[:64])[4:8] == b"ftyp"


def test_plots_show_the_filmed_episode(text):
    """Compare with the same episode, run again."""
    (episode,) = run_episodes(
        load_policy(PENDULUM), load_config(PENDULUM).evaluation_env.build, 1, MEDIAN
    )
    drawn = curves(text, "Torque at the shaft")
    arm = episode.actuator.arm_radius
    np.testing.assert_allclose(
        drawn["actual"][1][:-1], episode.trace["actual_force"] * arm, rtol=1e-6
    )
    steps = np.repeat(episode.signals["desired_force"], episode.inner_steps) * arm
    np.testing.assert_allclose(drawn["desired"][1][:-1], steps, rtol=1e-6)
    error = curves(text, "Error: desired minus actual")["desired minus actual"][1][:-1]
    np.testing.assert_allclose(error, steps - episode.trace["actual_force"] * arm, atol=1e-6)
    reward = curves(text, "Reward of each step")["reward"]
    np.testing.assert_allclose(reward[1][:-1], episode.reward, rtol=1e-6)
    assert reward[0][-1] == pytest.approx(episode.time[-1])
    current, voltage = (episode.trace[name] for name in ("current", "voltage"))
    power = curves(text, "Power and losses")
    np.testing.assert_allclose(power["electrical"][1][:-1], current * voltage, rtol=1e-5, atol=1e-9)
    (transport,) = re.findall(r'type="range" min="0" max="([^"]+)"', text)
    assert float(transport) == pytest.approx(episode.time[-1])


def test_the_papers_current_loop_has_margins_and_a_step(text):
    parsed = check_self_contained(text)
    titles = {data["title"] for data in parsed.data}
    assert {"Bode: gain", "Bode: phase", "A small step of the current, the shaft held"} <= titles
    assert "phase margin" in parsed.text
    assert f"seed {MEDIAN}" in parsed.text.partition("An episode")[2]


def test_omitted_and_missing_loops_are_explained():
    def run_with(actuators):
        return RunEpisode("run", SimpleNamespace(actuators_by_name=actuators), None, None, None, 0)

    drives = {
        f"m{index}": find_drive("maxon-dcx22l", bandwidth=300.0 + index) for index in range(6)
    }
    assert "Only the first 4 of 6 different loops are shown, without those of m4, m5" in str(
        reports._loop([run_with(drives)])
    )
    section = str(reports._loop([run_with({"lag": Lag(time_constant=0.1)})]))
    assert "lag: First-order lag with an optional delay: the torque follows the command" in section
    assert "It has no current loop." in section
    assert "m: assumed, because not specified: supply.voltage = 24 V" in str(
        reports._loop([run_with({"m": Drive()})])
    )


@pytest.fixture
def run(tmp_path):
    """Return a copy of a finished run."""
    return shutil.copytree(PENDULUM, tmp_path / "a<b> & run")


def report_page(*runs, **options):
    """Write the report of runs, and return the parsed page."""
    return check_self_contained(
        report(runs, runs[-1].with_name("r.html"), with_film=False, **options).read_text()
    )


def test_without_opengl_only_the_film_is_missing(tmp_path, monkeypatch):
    def no_film(*_, **__):
        raise RenderingUnavailableError("cannot make an OpenGL context: none here")

    monkeypatch.setattr(episodes, "clip", no_film)
    text = report([PENDULUM], tmp_path / "r.html").read_text()
    parsed = check_self_contained(text)
    assert (
        "No film of pendulum: RenderingUnavailableError: cannot make an OpenGL context"
        in parsed.text
    )
    assert "<video" not in text
    assert len(parsed.data) > 8


def write_evaluation(run, returns, folder="."):
    """Write an evaluation with these returns into a run."""
    content = json.loads((PENDULUM / "evaluation.json").read_text())
    content.pop("sha256", None)
    conditions = {"env": load_config(PENDULUM).env.as_mapping(), "seed": 1_000_000}
    changed = content | {"episode_returns": returns, "conditions": conditions}
    (run / folder / "evaluation.json").write_text(json.dumps(changed))


def test_the_episode_is_the_median_one_or_has_its_rank(run):
    write_evaluation(run, [-900.0, -200.0, -1500.0, -300.0, -1000.0])
    assert "seed 1000000, return" in report_page(run).text  # that of the median, -900
    text = report_page(run, seed=7).text
    (episode,) = run_episodes(load_policy(run), load_config(run).evaluation_env.build, 1, 7)
    worse = sum(value < episode.total for value in (-900.0, -200.0, -1500.0, -300.0, -1000.0))
    assert "seed 7, return" in text
    assert (
        f"{worse} of 5 evaluated episodes had a lower return; the median is -900 (seed 1000000)"
        in text
    )
    write_evaluation(run, [])
    text = report_page(run).text
    assert "seed 0, return" in text
    assert "evaluated episodes" not in text


def test_the_best_policy_uses_the_median_of_its_own_evaluation(run, capsys):
    (run / "best").mkdir()
    for name in ("policy.json", "policy.safetensors"):
        shutil.copy(PENDULUM / name, run / "best")
    write_evaluation(run, [-1.0, -2.0, -3.0], "best")
    assert "seed 1000001, return" in report_page(run, which="best").text
    write_evaluation(run, [-7.0, -8.0, -9.0])
    for which, median in (("best", "-2 (seed 1000001)"), ("last", "-8 (seed 1000001)")):
        assert main(["replay", str(run), "--which", which, "--out", str(run / "r.html")]) == 0
        assert f"had a lower return; the median is {median}" in capsys.readouterr().out
    assert main(["replay", str(run), "--actuator", "weaker", "--out", str(run / "r.html")]) == 0
    assert "evaluated" not in capsys.readouterr().out  # in another environment


def test_an_unfinished_run_is_reported_as_far_as_it_goes(run):
    for name in ("result.json", "evaluation.json", "policy.json", "policy.safetensors"):
        (run / name).unlink()
    parsed = report_page(run)
    assert "The training is not finished" in parsed.text
    assert "No episode of a<b> & run: the run has no policy yet" in parsed.text
    assert "a<b> & run has no evaluation" in parsed.text
    assert "Return while learning" in parsed.text
    (run / "best").mkdir()
    for name in ("policy.json", "policy.safetensors"):
        shutil.copy(PENDULUM / name, run / "best")
    assert "the policy of its best evaluation acts" in report_page(run).text


def test_the_damage_of_a_run_is_named(run):
    for name in ("evaluation.json", "certificate.json"):
        (run / name).write_text("{")
    content = json.loads((run / "config.json").read_text())
    content["train"]["agent"]["learning_rate"] = "nonsense"
    (run / "config.json").write_text(json.dumps(content))
    parsed = report_page(run)
    assert "The run folder is damaged" in parsed.text
    assert "evaluation.json is not a policy evaluation: it is truncated" in parsed.text
    assert "certificate.json is not a certificate" in parsed.text
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
    text = report([PENDULUM, run], run.with_name("r.html"), with_film=False).read_text()
    parsed = check_self_contained(text)
    assert {"pendulum: actual", "a<b> & run: actual"} <= curves(text, "Torque at the shaft").keys()
    assert text.count('name="show-run"') == 2
    assert "passed: 1 of 1 checks" in parsed.text
    assert "What differs between the runs" in parsed.text


def motors_of(section):
    """Return labels and tags of the curves of torque."""
    torque = next(
        data for data in ParsedPage(section).data if data["title"] == "Torque at the shaft"
    )
    return [(curve["label"], curve["tags"][1]) for curve in torque["curves"]]


def test_motors_can_be_selected():
    env = load_config(PENDULUM).evaluation_env
    (single_motor,) = run_episodes(load_policy(PENDULUM), env.build, 1, 0)
    arrays = {
        field: {
            name: np.stack([values, 2.0 * values], axis=1)
            for name, values in getattr(single_motor, field).items()
        }
        for field in ("trace", "signals")
    }
    arrays |= {"first_speeds": np.repeat(single_motor.first_speeds, 2)}
    two_motors = dataclasses.replace(
        single_motor, actuator=(single_motor.actuator,) * 2, motors=("left", "right"), **arrays
    )
    section = str(episode_section([RunEpisode("arm", env, two_motors, None, "not requested", 0)]))
    assert motors_of(section) == [
        (f"{side}: {signal}", f"motor:{index}")
        for index, side in enumerate(two_motors.motors)
        for signal in ("actual", "desired")
    ]
    assert section.count('name="show-motor"') == 2
    assert "No film of arm: not requested" in ParsedPage(section).text


def test_an_ideal_actuator_beside_a_motor_is_labeled_as_force():
    envs = (EnvConfig("pendulum", name, max_episode_steps=2) for name in ("weak", "ideal"))
    shown = [
        run_and_film(env.actuator.family, env, RandomPolicy("pendulum"), 0, with_film=False)
        for env in envs
    ]
    labels = {
        plot["title"]: plot["y"]["label"] for plot in ParsedPage(str(episode_section(shown))).data
    }
    assert labels["Torque at the shaft"] == "torque [N·m], of the ideal actuator force [N]"
    ideal_plots = ParsedPage(str(episode_section(shown[1:]))).data
    assert "Force" in [plot["title"] for plot in ideal_plots]


def test_each_plot_is_shaded_where_its_limit_is_reached():
    geared = find_drive("maxon-ec45-flat-50w", gear_ratio=20.0)
    drive = dataclasses.replace(geared, controller=SampledLoop(max_current=0.1))
    env = EnvConfig("pendulum", drive, max_episode_steps=10)
    section = str(
        episode_section(
            [run_and_film("limited", env, RandomPolicy("pendulum"), 0, with_film=False)]
        )
    )
    shades = {
        plot["title"]: {
            shade["label"]: len(plot["arrays"][shade["spans"]]) for shade in plot["shades"]
        }
        for plot in ParsedPage(section).data
    }
    assert list(shades["Torque at the shaft"]) == ["saturated"]
    assert list(shades["Current and its reference"]) == [
        "current saturated",
        "temperature saturated",
    ]
    assert shades["Voltage and its limit"] == {"voltage saturated": 0}
    assert shades["Current and its reference"]["current saturated"] > 0


def test_states_of_every_kind_of_joint_have_units(monkeypatch):
    """Compare with the coordinates and velocities of a ball, a slide, a hinge and a free joint.

    These are a quaternion, a meter, a radian, and three meters with a quaternion.
    """
    bodies = "".join(
        f'<body><joint type="{kind}"/><geom size=".1"/></body>'
        for kind in ("ball", "slide", "hinge")
    )
    bodies += "<body><freejoint/><geom size='.1'/></body>"
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")
    env = SimpleNamespace(unwrapped=SimpleNamespace(model=model), close=lambda: None)
    monkeypatch.setattr(EnvConfig, "build", lambda _: env)
    names = state_names(EnvConfig("Ant-v5"))
    units = [re.search(r"\[(.*)\]", name)[1] for name in names]
    assert units[: model.nq] == ["1"] * 4 + ["m", "rad"] + ["m"] * 3 + ["1"] * 4
    assert units[model.nq :] == ["rad/s"] * 3 + ["m/s", "rad/s"] + ["m/s"] * 3 + ["rad/s"] * 3


def test_a_torque_step_uses_the_time_step_of_each_actuator():
    """Compare with the exact step response 1 - exp(-t/T) of a lag."""
    lag = Lag(time_constant=0.05)
    plot = torque_step_plot({"slow": (lag, 2.0, 0.02), "fast": (lag, 1.0, 0.01)})
    slow, fast, reference = plot.curves
    for curve, step in ((slow, 0.02), (fast, 0.01)):
        assert f"steps of {1e3 * step:g} ms" in curve.label
        np.testing.assert_allclose(np.diff(curve.x), step)
        np.testing.assert_allclose(curve.y, 1.0 - np.exp(-curve.x / 0.05), atol=1e-12)
    assert reference.x[-1] == max(slow.x[-1], fast.x[-1])


@pytest.mark.matrix
def test_a_third_party_robot_with_motors_is_filmed():
    env = EnvConfig(
        "Reacher-v5", {"joint0": "maxon-ec45-flat-50w", "joint1": "quanser-qube-servo-2"}
    )
    shown = run_and_film("reacher", env, RandomPolicy(env.build().action_space), 0)
    assert shown.problem is None
    assert 1.0 / shown.episode.time[0] == pytest.approx(50.0)
    # Every second frame is left out, because clips have at most 30 frames per second.
    assert shown.film.rate == pytest.approx(25.0)
    section = str(episode_section([shown]))
    assert [tag for _, tag in motors_of(section)] == ["motor:0", "motor:0", "motor:1", "motor:1"]
    assert "State: target x, target y" in ParsedPage(section).text


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
            "is not a certificate: KeyError: 'checks'",
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
