"""Report of a run, or of several side by side: training, evaluation, an episode, current loops."""

import dataclasses
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from markupsafe import Markup

from codrl_mj.actuators import ActuatorModel, DCMotorActuator, Drive, Ideal
from codrl_mj.boundary import Json
from codrl_mj.evaluation import Episode
from codrl_mj.evaluation.evaluate import MEASURES
from codrl_mj.plots import Curve, Plot
from codrl_mj.runs import BEST, EPISODES, PROGRESS, finished, unique_names
from codrl_mj.runs.files import check_page, read_json
from codrl_mj.runs.policies import load_policy
from codrl_mj.runs.summaries import (
    RunSummary,
    compare,
    describe_rank,
    median_seed,
    read_evaluation,
    read_progress,
    read_run,
)
from codrl_mj.sizing import CurrentLoopActuator, is_closed
from codrl_mj.tasks import TASKS
from codrl_mj.training.folder import load_config
from codrl_mj.training.history import learning_curves, read_episodes
from codrl_mj.viz.pages import certificate as certificates
from codrl_mj.viz.pages import page
from codrl_mj.viz.pages.diagrams import torque_step_plot
from codrl_mj.viz.pages.episode import RunEpisode, episode_section, run_and_film
from codrl_mj.viz.pages.motor import loop_section

_MAX_LOOPS = 4


def report(
    runs: Sequence[Path],
    out: Path,
    *,
    which: str = "last",
    seed: int | None = None,
    trust: bool = False,
    with_film: bool = True,
    certificate: Path | None = None,
    extra_parts: Callable[[Sequence[RunEpisode]], Sequence[Markup]] = lambda _: (),
    on_part: Callable[[str], None] = lambda _: None,
) -> Path:
    """Write a report as one HTML page.

    Args:
        runs: run folders, at least one; also unfinished and damaged ones.
        out: the page, an .html file.
        which: policy of the episode, `last` or `best`. An unfinished run has only its best one.
        seed: seed of the episode; None: that of the evaluated episode with the median return, or 0
            without an evaluation.
        trust: import custom modules that a run folder names as its task, agent or actuator, which
            executes their code.
        with_film: film the episode.
        certificate: a `certificate.json`, or its folder; None: the one in a run folder, if any.
        extra_parts: function that returns, for the episodes, parts that follow the clock of film
            and plots (`codrl_mj.viz.pages.page.clocked_part`); `replay_parts` shows them in 3D.
        on_part: called with a description of each part of the work.

    Returns:
        `out`.

    Raises:
        FileNotFoundError: a folder is not a run folder, or the certificate does not exist.
        ValueError: no run, a seed below 0, `out` is not an .html file, or the given certificate is
            damaged.
    """
    if not runs:
        raise ValueError("runs: none was given; give one or more run folders")
    if seed is not None and seed < 0:
        raise ValueError(f"seed = {seed}: must be >= 0")
    check_page(out)
    # Read the certificate first: a wrong path is reported before any episode is run.
    certified = _certificate(runs, certificate)
    summaries = [read_run(path) for path in runs]
    reported = [
        _run_episode(summary, name, which, seed, trust, with_film, on_part)
        for summary, name in zip(
            summaries, unique_names([summary.path for summary in summaries]), strict=True
        )
    ]
    on_part("page")
    runs_with_episode = [run for run in reported if run.episode is not None]
    notes = [
        page.note(f"No episode of {run.name}: {run.problem}", bad=True)
        for run in reported
        if run.episode is None
    ]
    notes += [
        page.note(f"{run.name}: the policy of its best evaluation acts.")
        for run in reported
        if run.best
    ]
    episode = (
        episode_section(runs_with_episode, extra_parts(runs_with_episode))
        if runs_with_episode
        else Markup()
    )
    sections = [
        page.Section("learning", "Learning", _learning(reported)),
        page.Section("evaluation", "Evaluation", _evaluation(reported)),
        page.Section("episode", "An episode", page.join((*notes, episode))),
        page.Section("loop", "Current loop", _loop(reported)),
        page.Section("certificate", "Certificate", certified),
        page.Section("settings", "Settings", _settings(reported)),
    ]
    kicker = "Report of a run" if len(reported) == 1 else f"Report of {len(reported)} runs"
    title = ", ".join(run.name for run in reported)
    return page.write(out, page.page(title, kicker, _top(reported, runs_with_episode), sections))


def _run_episode(
    summary: RunSummary,
    name: str,
    which: str,
    requested_seed: int | None,
    trust: bool,
    with_film: bool,
    on_part: Callable[[str], None],
) -> RunEpisode:
    """Return a run with an episode, if it can be run."""
    best = which == "best" or not finished(summary.path)
    evaluation = read_evaluation(summary.path, best)
    seed = requested_seed if requested_seed is not None else median_seed(evaluation) or 0
    try:
        config = load_config(summary.path, trust)
    except (ValueError, OSError, ImportError) as error:
        return RunEpisode(name, None, None, None, str(error), seed, summary=summary)
    env = config.evaluation_env
    policy = summary.path / BEST if best else summary.path
    if not (policy / "policy.json").is_file():
        missing = "best policy" if finished(summary.path) else "policy yet"
        return RunEpisode(
            name,
            env,
            None,
            None,
            f"the run has no {missing}: none was evaluated so far",
            seed,
            summary=summary,
        )
    try:
        on_part(f"{name}: episode")
        result = run_and_film(name, env, load_policy(policy, trust), seed, with_film)
        return result._replace(
            best=best, summary=summary, rank=describe_rank(evaluation, result.known_episode.total)
        )
    # Third-party environments and actuators may raise any error. The report names it and shows the
    # rest.
    except Exception as error:
        return RunEpisode(
            name, env, None, None, f"{type(error).__name__}: {error}", seed, summary=summary
        )


def _top(runs: Sequence[RunEpisode], runs_with_episode: Sequence[RunEpisode]) -> Markup:
    """Return an introduction: sentences about each run, and a picture."""
    paragraphs: list[Markup] = []
    for run in runs:
        text = (
            Markup("<b>{}</b>: {}").format(run.name, _sentence(run.known_summary))
            if len(runs) > 1
            else _sentence(run.known_summary)
        )
        paragraphs.append(page.paragraph(text, "lead"))
        if run.known_summary.state == "unfinished":
            paragraphs.append(
                page.note("The training is not finished. This report shows its results so far.")
            )
        if run.known_summary.state == "damaged":
            paragraphs.append(
                page.note(f"The run folder is damaged: {run.known_summary.problem}", bad=True)
            )
    paragraphs += [
        page.paragraph(_task_summary(task), "soft")
        for task in dict.fromkeys(run.known_summary.task for run in runs)
        if task
    ]
    for run_episode in runs_with_episode:
        if run_episode.film is not None:
            picture = page.render_part(
                "image",
                run_episode.film.still,
                f"{run_episode.known_env.task}: the scene of an episode",
            )
            return Markup('<div class="intro"><div>{}</div>{}</div>').format(
                page.join(paragraphs), picture
            )
    return page.join(paragraphs)


def _sentence(run: RunSummary) -> str:
    """Return a sentence about the training of a run and its results."""
    agent = run.agent.upper() if run.agent else "An agent"
    steps = f", trained for {run.steps:,} environment steps" if run.steps else ", not trained yet"
    if run.steps and run.total_steps and run.state == "unfinished":
        steps += f" of {run.total_steps:,}"
    actuator_texts = {
        "ideal": "the ideal actuator",
        "custom": "a custom actuator",
        "drive": "a motor behind a drive",
    }
    actuator = actuator_texts.get(
        run.actuator or "", f"the actuator{'s' * (', ' in (run.actuator or ''))} {run.actuator}"
    )
    text = f"{agent} on {run.task or 'an unknown task'} through {actuator}{steps}, seed {run.seed}."
    if run.evaluation is not None and run.evaluation_return is not None:
        returns = page.format_number(run.evaluation["returns"])
        episodes = run.evaluation.get("episodes")
        text += f" Its policy returns {returns} over {episodes} episodes"
        if isinstance(success := run.evaluation.get("success"), Mapping):
            text += f" and succeeds in {100 * success['mean']:.3g} % of them"
        text += "."
    return text


def _task_summary(task: str) -> str:
    """Return the first line of a task's documentation."""
    if task not in TASKS:
        return f"The environment {task}."
    text = sys.modules[TASKS[task].reward.__module__].__doc__ or ""
    return text.strip().partition("\n")[0]


def _learning(runs: Sequence[RunEpisode]) -> Markup:
    """Return learning curves from the runs' tables.

    With several runs, each run has one color and no dots.
    """
    notes: list[Markup] = []
    returns: list[Curve] = []
    evaluations: list[Curve] = []
    errors: list[Curve] = []
    for index, run in enumerate(runs):
        reports = read_progress(run.known_summary.path / PROGRESS, [])
        columns = [
            [row.get(name, "nan") for row in reports]
            for name in ("steps", "evaluation_return", "torque_error")
        ]
        try:
            steps, evaluated, torque_errors = np.array(columns, dtype=np.float64)
        # A damaged table has a cell that is not a number.
        except ValueError:
            steps, evaluated, torque_errors = np.empty((3, 0))
        try:
            episodes = read_episodes(run.known_summary.path / EPISODES)
        except (ValueError, OSError) as error:
            episodes = np.empty((0, 4))
            notes.append(page.note(f"No curve of {run.name}'s training episodes: {error}"))
        is_known = np.isfinite(torque_errors)
        error_curves = (
            [Curve("torque error", steps[is_known], torque_errors[is_known], colour=4)]
            if is_known.any()
            else []
        )
        for curve in (*learning_curves(episodes, steps, evaluated), *error_curves):
            target = {"evaluations": evaluations, "torque error": errors}.get(curve.label, returns)
            if len(runs) == 1:
                target.append(curve)
            elif curve.style != "dots":
                label, dashed = f"{run.name}: {curve.label}", target is not returns
                target.append(dataclasses.replace(curve, label=label, colour=index, dashed=dashed))
    plots = []
    if returns or evaluations:
        plots.append(
            Plot("Return while learning", "environment steps", "return", (*returns, *evaluations))
        )
    if any(np.any(curve.y) for curve in errors):
        title = "Desired minus delivered torque at the ends of environment steps, rms"
        plots.append(Plot(title, "environment steps", "torque error [N·m]", tuple(errors)))
    if not plots and not notes:
        notes.append(page.note("No learning curve yet: no training episode has ended."))
    return page.join((*notes, page.plots(plots)))


def _evaluation(runs: Sequence[RunEpisode]) -> Markup:
    """Return the measures of the evaluations, with their intervals."""
    evaluated = [run for run in runs if run.known_summary.evaluation is not None]
    notes = [
        page.note(
            f"{run.name} has no evaluation: its last policy is evaluated when the training ends."
        )
        for run in runs
        if run.known_summary.evaluation is None
    ]
    if not evaluated:
        return page.join(notes)
    evaluations = [dict(run.known_summary.evaluation or {}) for run in evaluated]
    episode_counts = " and ".join(
        dict.fromkeys(str(evaluation.get("episodes")) for evaluation in evaluations)
    )
    names = [run.name if len(evaluated) > 1 else "value" for run in evaluated]
    table = _measures(
        f"Last policy, {episode_counts} episodes; 95 % intervals in brackets",
        dict(zip(names, evaluations, strict=True)),
    )
    curves = []
    for index, (run, evaluation) in enumerate(zip(evaluated, evaluations, strict=True)):
        returns = np.sort(np.array(evaluation.get("episode_returns") or [], dtype=float))
        if len(returns) > 1:
            share = 100.0 * (np.arange(len(returns)) + 0.5) / len(returns)
            curves.append(
                Curve(
                    run.name if len(evaluated) > 1 else "episodes",
                    share,
                    returns,
                    colour=index,
                    style="dots",
                )
            )
    title = "Returns of the evaluation's episodes, in order"
    plots = page.plots(
        [Plot(title, "share of episodes below [%]", "return", tuple(curves))] if curves else []
    )
    # A table of several runs needs the whole width.
    template = '<div class="beside">{}{}</div>' if len(evaluated) == 1 else "{}{}"
    motor_tables = [
        (f"{run.name}: motor by motor", evaluation.get("motors"))
        for run, evaluation in zip(evaluated, evaluations, strict=True)
    ]
    folded = [
        page.details(caption, _measures(caption, motors))
        for caption, motors in motor_tables
        if isinstance(motors, Mapping) and motors
    ]
    return page.join((*notes, Markup(template).format(table, plots), *folded))


def _measures(caption: str, columns: Mapping[str, Mapping[str, Json]]) -> Markup:
    """Return a table with a row for each measure that at least one column has."""
    rows = []
    for name, field in MEASURES.items():
        values = [column.get(name) for column in columns.values()]
        if any(value is not None for value in values):
            rows.append(
                (
                    field.metadata["label"],
                    *map(page.format_number, values),
                    page.format_unit(field.metadata["unit"]),
                )
            )
    return page.table(
        caption, ("measure", *columns, "unit"), rows, numbers=range(1, 1 + len(columns))
    )


def replay_parts(runs: Sequence[RunEpisode]) -> list[Markup]:
    """Return the episodes as interactive 3D replays, for `extra_parts` of a report."""
    from codrl_mj.viz.replay import SCRIPT, library_script, motion_of_episode, replay_html

    parts = [Markup("<script>{}</script>").format(Markup(library_script()))]
    for run in runs:
        fragment = replay_html(motion_of_episode(run.known_episode, run.known_env), run.name)
        parts.append(
            Markup("<figure>{}</figure>").format(
                page.clocked_part(f"Replay: {run.name}", fragment, SCRIPT)
            )
        )
    return parts


def _loop(runs: Sequence[RunEpisode]) -> Markup:
    """Return the different current loops, and torque steps of actuators without one."""
    loops: dict[str, tuple[CurrentLoopActuator, float | None]] = {}
    steps: dict[str, tuple[ActuatorModel, float, float]] = {}
    notes: dict[str, None] = {}
    known_loops: list[tuple[object, ...]] = []
    for run in runs:
        driven = run.env.actuators_by_name if run.env is not None else {}
        for motor, actuator in driven.items():
            name = (
                motor
                if len(runs) == 1
                else run.name
                if len(driven) == 1
                else f"{run.name}, {motor}"
            )
            name = "motor" if name == ".*" else name
            timestep = run.episode.timestep if run.episode is not None else None
            if actuator.assumed:
                notes[f"{name}: {actuator.assumed}."] = None
            if isinstance(actuator, Drive | DCMotorActuator) and is_closed(actuator):
                loop = actuator, None if isinstance(actuator, Drive) else timestep
                is_comparable = isinstance(actuator, Drive) or timestep is not None
                identity = (actuator.winding, actuator.controller, actuator.voltage_limit, loop[1])
                # Two runs with the same loop get one Bode plot. A loop that is not sampled by a
                # drive also depends on the mechanical step.
                if is_comparable and identity not in known_loops:
                    known_loops.append(identity)
                    loops[name] = loop
                continue
            if isinstance(actuator, DCMotorActuator):
                reason = (
                    "feed-forward only, without a gain on the current's error: there is no loop to"
                    " analyze."
                )
            else:
                description = (
                    (type(actuator).__doc__ or type(actuator).__name__).strip().partition("\n")[0]
                )
                reason = f"{description} It has no current loop."
            notes[f"{name}: {reason}"] = None
            if timestep is None or isinstance(actuator, Ideal):
                continue
            if all(
                (actuator, timestep) != (known_actuator, step)
                for known_actuator, _, step in steps.values()
            ):
                steps[name] = actuator, _step_torque(actuator, run.known_episode), timestep
    parts = [page.paragraph(text, "soft") for text in notes]
    if len(loops) > _MAX_LOOPS:
        omitted = ", ".join(list(loops)[_MAX_LOOPS:])
        parts.append(
            page.note(
                f"Only the first {_MAX_LOOPS} of {len(loops)} different loops are shown, without"
                f" those of {omitted}"
            )
        )
    if loops:
        parts.append(loop_section(dict(list(loops.items())[:_MAX_LOOPS])))
    plot = torque_step_plot(steps)
    return page.join((*parts, page.plots([plot] if plot is not None else [])))


def _step_torque(actuator: ActuatorModel, episode: Episode) -> float:
    """Return half of the largest desired torque of an actuator in an episode [N*m].

    If no motor of the episode has this actuator, because it was randomized, all motors count.
    """
    forces = np.atleast_2d(np.abs(np.asarray(episode.signals["desired_force"], dtype=float)).T)
    actuators = episode.actuator if isinstance(episode.actuator, tuple) else (episode.actuator,)
    is_own = [candidate == actuator for candidate in actuators]
    return 0.5 * actuator.arm_radius * float(forces[is_own if any(is_own) else slice(None)].max())


def _certificate(runs: Sequence[Path], requested_path: Path | None) -> Markup:
    """Return a summary of the certificate, if there is one."""
    paths = [file for path in runs if (file := path / certificates.JSON_NAME).is_file()]
    if requested_path is not None:
        paths = [
            requested_path / certificates.JSON_NAME if requested_path.is_dir() else requested_path
        ]
    for file in paths[:1]:
        try:
            return certificates.summary(read_json(file, "certificate"))
        except (KeyError, TypeError, ValueError) as error:
            problem = f"{file} is not a certificate: {type(error).__name__}: {error}"
            if requested_path is not None:
                raise ValueError(problem) from None
            return page.note(problem, bad=True)
    return Markup()


def _settings(runs: Sequence[RunEpisode]) -> Markup:
    """Return the settings that differ between the runs, and all settings of each run."""
    parts = []
    if len(runs) > 1:
        differing = compare([run.known_summary for run in runs]).configuration
        rows = [(name, *map(_setting_text, values)) for name, values in differing.items()]
        columns = ("setting", *(run.name for run in runs))
        parts.append(page.table("What differs between the runs", columns, rows, cards=True))
    for run in runs:
        rows = [
            (name, _setting_text(value)) for name, value in run.known_summary.configuration.items()
        ]
        label = f"All settings of {run.name}"
        if rows:
            parts.append(page.details(label, page.table(label, ("setting", "value"), rows)))
    return page.join(parts)


def _setting_text(value: object) -> str:
    return value if isinstance(value, str) else json.dumps(value)
