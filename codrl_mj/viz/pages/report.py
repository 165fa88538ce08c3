"""A run's report, or that of several side by side: what they are, learned, achieved, and what their motors did."""

import dataclasses
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from codrl_mj.actuators import ActuatorModel, DCMotorActuator, Drive, Ideal
from codrl_mj.evaluation import Episode
from codrl_mj.evaluation.evaluate import MEASURES
from codrl_mj.runs import BEST, EPISODES, PROGRESS, finished, unique_names
from codrl_mj.runs.files import check_page, read_json
from codrl_mj.runs.policies import load_policy
from codrl_mj.runs.summaries import (
    RunSummary,
    compare,
    describe_rank,
    read_evaluation,
    read_reports,
    read_run,
    median_seed,
)
from codrl_mj.sizing import CurrentLoopActuator, is_closed
from codrl_mj.training.folder import load_config
from codrl_mj.training.history import learning_curves, read_episodes
from codrl_mj.viz.pages import certificate as certificates
from codrl_mj.viz.pages import page
from codrl_mj.viz.pages.diagrams import held_step
from codrl_mj.viz.pages.episode import Shown, episode_section, show
from codrl_mj.viz.pages.motor import loop_section
from codrl_mj.viz.pages.plots import Curve, Plot

_MOST_LOOPS = 4


def report(
    runs: Sequence[Path],
    out: Path,
    *,
    which: str = "last",
    seed: int | None = None,
    trust: bool = False,
    filmed: bool = True,
    certificate: Path | None = None,
    joined: Callable[[Sequence[Shown]], Sequence[Markup]] = lambda _: (),
    on_part: Callable[[str], None] = lambda _: None,
) -> Path:
    """Write a report.

    Args:
        runs: run folders, at least one; also unfinished and damaged ones.
        out: the page, an .html file.
        which: `last` or `best`: whose policy acts in the episode. An unfinished run has only its
            best so far.
        seed: of the episode; None: that of the evaluated episode with the median return, or 0 where
            there is none.
        trust: whether to import modules that a run folder names as its task, agent or actuator,
            which executes them.
        filmed: whether to film the episode.
        certificate: a `certificate.json`, or the folder of one; None: that in a run folder, if
            there is one.
        joined: (episodes) -> parts that follow the clock of film and plots, made by
            `codrl_mj.viz.pages.page.clocked`; `replays` shows them in three dimensions.
        on_part: called with what is being done.

    Returns:
        `out`.

    Raises:
        FileNotFoundError: a folder is no run folder, or there is no such certificate.
        ValueError: no run, a seed below 0, `out` is no .html file, or the certificate that is given
            is damaged.
    """
    if not runs:
        raise ValueError("runs: none was given; give one run folder or more")
    if seed is not None and seed < 0:
        raise ValueError(f"seed = {seed}: must be >= 0")
    check_page(out)
    certified = _certificate(runs, certificate)
    summaries = [read_run(path) for path in runs]
    found = [
        _run(one, name, which, seed, trust, filmed, on_part)
        for one, name in zip(summaries, unique_names([one.path for one in summaries]), strict=True)
    ]
    on_part("page")
    shown = [run for run in found if run.episode is not None]
    notes = [
        page.note(f"No episode of {run.name}: {run.problem}", bad=True)
        for run in found
        if run.episode is None
    ]
    notes += [
        page.note(f"{run.name}: the policy of its best evaluation acts.")
        for run in found
        if run.best
    ]
    episode = episode_section(shown, joined(shown)) if shown else Markup()
    sections = [
        page.Section("learning", "Learning", _learning(found)),
        page.Section("evaluation", "Evaluation", _evaluation(found)),
        page.Section("episode", "An episode", page.joined((*notes, episode))),
        page.Section("loop", "The loop between", _loop(found)),
        page.Section("certificate", "Certificate", certified),
        page.Section("settings", "Settings", _settings(found)),
    ]
    kinds = "Report of a run" if len(found) == 1 else f"Report of {len(found)} runs"
    title = ", ".join(run.name for run in found)
    return page.write(out, page.page(title, kinds, _top(found, shown), sections))


def _run(
    summary: RunSummary,
    name: str,
    which: str,
    given: int | None,
    trust: bool,
    filmed: bool,
    on_part: Callable[[str], None],
) -> Shown:
    """A run with an episode, as far as there is one."""
    best = which == "best" or not finished(summary.path)
    evaluation = read_evaluation(summary.path, best)
    seed = given if given is not None else median_seed(evaluation) or 0
    try:
        config = load_config(summary.path, trust)
    except (ValueError, OSError, ImportError) as error:
        return Shown(name, None, None, None, str(error), seed, summary=summary)
    env = config.evaluation_env
    policy = summary.path / BEST if best else summary.path
    if not (policy / "policy.json").is_file():
        yet = "best policy" if finished(summary.path) else "policy yet"
        return Shown(
            name,
            env,
            None,
            None,
            f"the run has no {yet}: none was evaluated so far",
            seed,
            summary=summary,
        )
    try:
        on_part(f"{name}: episode")
        shown = show(name, env, load_policy(policy, trust), seed, filmed)
        return shown._replace(
            best=best, summary=summary, rank=describe_rank(evaluation, shown.episode.total)
        )
    except Exception as error:  # environments and actuators of others raise what they like
        return Shown(
            name, env, None, None, f"{type(error).__name__}: {error}", seed, summary=summary
        )


def _top(runs: Sequence[Shown], shown: Sequence[Shown]) -> Markup:
    """What it is, in sentences and a picture."""
    told: list[Markup] = []
    for run in runs:
        text = (
            Markup("<b>{}</b>: {}").format(run.name, _sentence(run.summary))
            if len(runs) > 1
            else _sentence(run.summary)
        )
        told.append(page.paragraph(text, "lead"))
        if run.summary.state == "unfinished":
            told.append(page.note("The training is not finished. Here is what there is so far."))
        if run.summary.state == "damaged":
            told.append(page.note(f"The run folder is damaged: {run.summary.problem}", bad=True))
    told += [
        page.paragraph(_about(task), "soft")
        for task in dict.fromkeys(run.summary.task for run in runs)
        if task
    ]
    for one in shown:
        if one.film is not None:
            picture = page.part("image", one.film.still, f"{one.env.task}: the scene of an episode")
            return Markup('<div class="intro"><div>{}</div>{}</div>').format(
                page.joined(told), picture
            )
    return page.joined(told)


def _sentence(run: RunSummary) -> str:
    """What a run is and came to."""
    agent = run.agent.upper() if run.agent else "An agent"
    steps = f", trained for {run.steps:,} environment steps" if run.steps else ", not trained yet"
    if run.steps and run.total_steps and run.state == "unfinished":
        steps += f" of {run.total_steps:,}"
    named = {
        "ideal": "the ideal actuator",
        "custom": "an actuator of its own",
        "drive": "a motor behind a drive",
    }
    actuator = named.get(
        run.actuator or "", f"the actuator{'s' * (', ' in (run.actuator or ''))} {run.actuator}"
    )
    text = f"{agent} on {run.task or 'an unknown task'} through {actuator}{steps}, seed {run.seed}."
    if run.evaluation is not None and run.evaluation_return is not None:
        returns, episodes = page.number(run.evaluation["returns"]), run.evaluation.get("episodes")
        text += f" Its policy returns {returns} over {episodes} episodes"
        if isinstance(success := run.evaluation.get("success"), Mapping):
            text += f" and succeeds in {100 * success['mean']:.3g} % of them"
        text += "."
    return text


def _about(task: str) -> str:
    """The first line of what a task says of itself."""
    import importlib

    try:
        text = importlib.import_module(f"codrl_mj.tasks.{task}").__doc__ or ""
    except ImportError:  # somebody else's
        return f"The environment {task}."
    return text.strip().partition("\n")[0]


def _learning(runs: Sequence[Shown]) -> Markup:
    """Curves from the runs' tables; beside others a run has one colour and no dots."""
    notes: list[Markup] = []
    returns: list[Curve] = []
    evaluations: list[Curve] = []
    errors: list[Curve] = []
    for place, run in enumerate(runs):
        reports = read_reports(run.summary.path / PROGRESS, [])
        columns = [
            [row.get(name, "nan") for row in reports]
            for name in ("steps", "evaluation_return", "torque_error")
        ]
        try:
            steps, evaluated, off = np.array(columns, dtype=np.float64)
        except ValueError:  # a cell is no number
            steps, evaluated, off = np.empty((3, 0))
        try:
            episodes = read_episodes(run.summary.path / EPISODES)
        except (ValueError, OSError) as error:
            episodes = np.empty((0, 4))
            notes.append(page.note(f"No curve of {run.name}'s training episodes: {error}"))
        known = np.isfinite(off)
        off_torque = (
            [Curve("torque error", steps[known], off[known], colour=4)] if known.any() else []
        )
        for curve in (*learning_curves(episodes, steps, evaluated), *off_torque):
            into = {"evaluations": evaluations, "torque error": errors}.get(curve.label, returns)
            if len(runs) == 1:
                into.append(curve)
            elif curve.style != "dots":
                label, dashed = f"{run.name}: {curve.label}", into is not returns
                into.append(dataclasses.replace(curve, label=label, colour=place, dashed=dashed))
    found = []
    if returns or evaluations:
        found.append(
            Plot("Return while learning", "environment steps", "return", (*returns, *evaluations))
        )
    if any(np.any(curve.y) for curve in errors):
        title = "Torque asked for less torque delivered at the ends of environment steps, rms"
        found.append(Plot(title, "environment steps", "torque error [N·m]", tuple(errors)))
    if not found and not notes:
        notes.append(page.note("No learning curve yet: no training episode has ended."))
    return page.joined((*notes, page.plots(found)))


def _evaluation(runs: Sequence[Shown]) -> Markup:
    """Measures with their intervals."""
    known = [run for run in runs if run.summary.evaluation is not None]
    notes = [
        page.note(
            f"{run.name} has no evaluation: its last policy is evaluated when the training ends."
        )
        for run in runs
        if run.summary.evaluation is None
    ]
    if not known:
        return page.joined(notes)
    every = [dict(run.summary.evaluation or {}) for run in known]
    count = " and ".join(dict.fromkeys(str(one.get("episodes")) for one in every))
    names = [run.name if len(known) > 1 else "value" for run in known]
    table = _measures(
        f"Last policy, {count} episodes; 95 % intervals in brackets",
        dict(zip(names, every, strict=True)),
    )
    curves = []
    for place, (run, one) in enumerate(zip(known, every, strict=True)):
        returns = np.sort(np.array(one.get("episode_returns") or [], dtype=float))
        if len(returns) > 1:
            share = 100.0 * (np.arange(len(returns)) + 0.5) / len(returns)
            curves.append(
                Curve(
                    run.name if len(known) > 1 else "episodes",
                    share,
                    returns,
                    colour=place,
                    style="dots",
                )
            )
    title = "Returns of the evaluation's episodes, in order"
    beside = page.plots(
        [Plot(title, "share of episodes below [%]", "return", tuple(curves))] if curves else []
    )
    layout = (
        '<div class="beside">{}{}</div>' if len(known) == 1 else "{}{}"
    )  # a table of several needs the width
    of_motors = [
        (f"{run.name}: motor by motor", one.get("motors"))
        for run, one in zip(known, every, strict=True)
    ]
    folded = [
        page.folded(about, _measures(about, motors))
        for about, motors in of_motors
        if isinstance(motors, Mapping) and motors
    ]
    return page.joined((*notes, Markup(layout).format(table, beside), *folded))


def _measures(caption: str, columns: Mapping[str, Mapping[str, Any]]) -> Markup:
    """A row for each measure that one of the columns has."""
    rows = []
    for name, field in MEASURES.items():
        values = [column.get(name) for column in columns.values()]
        if any(value is not None for value in values):
            rows.append(
                (
                    field.metadata["label"],
                    *map(page.number, values),
                    page.unit(field.metadata["unit"]),
                )
            )
    return page.table(
        caption, ("measure", *columns, "unit"), rows, numbers=range(1, 1 + len(columns))
    )


def replays(shown: Sequence[Shown]) -> list[Markup]:
    """The episodes in three dimensions, to be turned and zoomed: what `joined` of a report may return."""
    from codrl_mj.viz.replay import SCRIPT, library, motion_of_episode, replay

    parts = [Markup("<script>{}</script>").format(Markup(library()))]
    for one in shown:
        fragment = replay(motion_of_episode(one.episode, one.env), one.name)
        parts.append(
            Markup("<figure>{}</figure>").format(
                page.clocked(f"Replay: {one.name}", fragment, SCRIPT)
            )
        )
    return parts


def _loop(runs: Sequence[Shown]) -> Markup:
    """Current loops, and steps of actuators without one; each different one once."""
    loops: dict[str, tuple[CurrentLoopActuator, float | None]] = {}
    others: dict[str, tuple[ActuatorModel, float, float]] = {}
    without: dict[str, None] = {}
    seen: list[Any] = []
    for run in runs:
        driven = run.env.driven if run.env is not None else {}
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
                without[f"{name}: {actuator.assumed}."] = None
            if isinstance(actuator, Drive | DCMotorActuator) and is_closed(actuator):
                loop = actuator, None if isinstance(actuator, Drive) else timestep
                known = isinstance(actuator, Drive) or timestep is not None
                same = (actuator.winding, actuator.controller, actuator.voltage_limit, loop[1])
                if known and same not in seen:
                    seen.append(same)
                    loops[name] = loop
                continue
            if isinstance(actuator, DCMotorActuator):
                why = (
                    "no gain on the error of the current, feed-forward alone: there is no loop to"
                    " be judged."
                )
            else:
                about = (
                    (type(actuator).__doc__ or type(actuator).__name__).strip().partition("\n")[0]
                )
                why = f"{about} There is no current loop in it."
            without[f"{name}: {why}"] = None
            if timestep is None or isinstance(actuator, Ideal):
                continue
            if all((actuator, timestep) != (one, step) for one, _, step in others.values()):
                others[name] = actuator, _asked(actuator, run.episode), timestep
    parts = [page.paragraph(text, "soft") for text in without]
    if len(loops) > _MOST_LOOPS:
        left = ", ".join(list(loops)[_MOST_LOOPS:])
        parts.append(
            page.note(
                f"The first {_MOST_LOOPS} of {len(loops)} different loops are shown; not those of"
                f" {left}"
            )
        )
    if loops:
        parts.append(loop_section(dict(list(loops.items())[:_MOST_LOOPS])))
    plot = held_step(others)
    return page.joined((*parts, page.plots([plot] if plot is not None else [])))


def _asked(actuator: ActuatorModel, episode: Episode) -> float:
    """Half of the largest torque that was asked of an actuator in an episode [N*m]; of all, where it was drawn anew."""
    forces = np.atleast_2d(np.abs(np.asarray(episode.signals["desired_force"], dtype=float)).T)
    driven = episode.actuator if isinstance(episode.actuator, tuple) else (episode.actuator,)
    own = [one == actuator for one in driven]
    return 0.5 * actuator.arm_radius * float(forces[own if any(own) else slice(None)].max())


def _certificate(runs: Sequence[Path], given: Path | None) -> Markup:
    """What the certificate says, if there is one."""
    known = [place for path in runs if (place := path / certificates.JSON_NAME).is_file()]
    if given is not None:
        known = [given / certificates.JSON_NAME if given.is_dir() else given]
    for place in known[:1]:
        try:
            return certificates.summary(read_json(place, "certificate"))
        except (KeyError, TypeError, ValueError) as error:
            problem = f"{place} is no certificate: {type(error).__name__}: {error}"
            if given is not None:
                raise ValueError(problem) from None
            return page.note(problem, bad=True)
    return Markup()


def _settings(runs: Sequence[Shown]) -> Markup:
    """What differs between the runs, and all that they were made with."""
    parts = []
    if len(runs) > 1:
        differing = compare([run.summary for run in runs]).configuration
        rows = [(name, *map(_setting, values)) for name, values in differing.items()]
        columns = ("setting", *(run.name for run in runs))
        parts.append(page.table("What differs between the runs", columns, rows, cards=True))
    for run in runs:
        rows = [(name, _setting(value)) for name, value in run.summary.configuration.items()]
        label = f"All settings of {run.name}"
        if rows:
            parts.append(page.folded(label, page.table(label, ("setting", "value"), rows)))
    return page.joined(parts)


def _setting(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)
