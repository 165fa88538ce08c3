"""One episode of each of several runs: films and plots on one clock."""

import itertools
import re
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from markupsafe import Markup

from codrl_mj.actuators import Ideal
from codrl_mj.envs.config import EnvConfig
from codrl_mj.evaluation import Episode, run_episodes
from codrl_mj.evaluation.evaluate import motor_traces
from codrl_mj.plots import MAX_POINTS, Curve, CurveOwner, CurveStyle, Plot, Shade, flagged_intervals
from codrl_mj.runs.policies import Policy
from codrl_mj.runs.summaries import RunSummary
from codrl_mj.viz.films.film import Clip, clip, record
from codrl_mj.viz.pages import page
from codrl_mj.viz.pages.diagrams import MotorSeries, episode_diagram
from codrl_mj.viz.scene import state_names

_SIZE = 480, 360
_MAX_EPISODE_POINTS = 400_000
"""Maximum number of points of all curves of an episode: two megabytes."""
_MAX_SHOWN_MOTORS = 3
"""With more motors than this, only one is shown at first."""
_MAX_STATES = 12
"""Maximum number of lines in a plot of states."""


class RunEpisode(NamedTuple):
    """A run with its episode, if an episode could be run."""

    name: str
    """Name of the run."""
    env: EnvConfig | None
    """Environment of the run; None if it cannot be read."""
    episode: Episode | None
    """Recorded episode; None if there is a problem."""
    film: Clip | None
    """Film of the scene; None if there is a problem."""
    problem: str | None
    """Reason why there is no episode, or no film."""
    seed: int
    """Seed of the episode."""
    best: bool = False
    """True if the policy is that of the best evaluation."""
    summary: RunSummary | None = None
    """Summary of the run folder."""
    rank: str = ""
    """Comparison of the episode's return with the run's evaluation."""

    @property
    def known_env(self) -> EnvConfig:
        """Environment of a run whose environment can be read."""
        assert self.env is not None
        return self.env

    @property
    def known_episode(self) -> Episode:
        """Episode of a run that has one."""
        assert self.episode is not None
        return self.episode

    @property
    def known_summary(self) -> RunSummary:
        """Summary of a run that was read from its folder."""
        assert self.summary is not None
        return self.summary


def run_and_film(
    name: str, env: EnvConfig, policy: Policy, seed: int, with_film: bool = True
) -> RunEpisode:
    """Run an episode in a run's environment, an `EnvConfig`, and film it if possible."""
    episode, film, problem = None, None, None if with_film else "not requested"
    if with_film:
        try:
            panel = record(policy, env, seed, *_SIZE)
            episode = panel.episode
            film = clip(panel, *_SIZE)
        except (
            # Each renderer, and each missing library, raises its own kind of error. The report is
            # written without the film.
            Exception
        ) as error:
            problem = f"{type(error).__name__}: {error}"
    return RunEpisode(
        name, env, episode or run_episodes(policy, env.build, 1, seed)[0], film, problem, seed
    )


def episode_section(runs: Sequence[RunEpisode], extra_parts: Iterable[Markup] = ()) -> Markup:
    """Return films, controls and plots of episodes side by side.

    Args:
        runs: the runs with their episodes.
        extra_parts: further parts on the same clock (`page.clocked_part`).
    """
    episodes = [run.known_episode for run in runs]
    motors = list(
        dict.fromkeys(name for episode in episodes for name in episode.motors or ("motor",))
    )
    series = _motor_series(runs, motors)
    end = max(float(episode.time[-1]) for episode in episodes)
    films = [
        page.render_part("film", _caption(run, len(runs) > 1), *run.film)
        for run in runs
        if run.film is not None
    ]
    selectors = (
        [page.render_part("selector", "Runs", "run", [run.name for run in runs], None)]
        if len(runs) > 1
        else []
    )
    if len(motors) > 1:
        selectors.append(
            page.render_part(
                "selector",
                "Motors",
                "motor",
                motors,
                0 if len(motors) > _MAX_SHOWN_MOTORS else None,
            )
        )
    notes = [page.note(f"No film of {run.name}: {run.problem}") for run in runs if run.film is None]
    stage = [
        *notes,
        Markup('<div class="pinned">{}{}</div>').format(
            Markup('<div class="films">{}</div>').format(page.join(films)) if films else "",
            page.render_part(
                "transport",
                f"{end:.6g}",
                f"{min(float(episode.time[0]) for episode in episodes):.6g}",
            ),
        ),
        Markup('<div class="selectors">{}</div>').format(page.join(selectors))
        if selectors
        else Markup(),
        *extra_parts,
    ]
    diagram = episode_diagram(series)
    if diagram is not None:
        stage.append(page.plot(diagram))
    plots = [page.plot(plot, low=True) for plot in (*_motor_plots(series), *_run_plots(runs))]
    footnotes = [page.paragraph(_caption(run, True), "soft") for run in runs] if not films else []
    if series and series[0].stride > 1:
        footnotes.append(
            page.paragraph(f"The plots show every {series[0].stride}th integration step.", "soft")
        )
    return page.join(
        (
            page.paragraph(
                "Film and plots share a clock: play the film, or drag in any plot over time."
                " Torque, current and speed are those of the motor, at its shaft."
            ),
            *footnotes,
            Markup(
                '<div class="episode"><div class="stage">{}</div><div class="stack">{}</div></div>'
            ).format(page.join(stage), page.join(plots)),
        )
    )


def _caption(run: RunEpisode, with_name: bool) -> str:
    episode = run.known_episode
    ending = f"{'ended' if episode.terminated else 'time limit'} at {episode.time[-1]:.2f} s"
    caption = (
        f"{run.name + ': ' if with_name else ''}seed {run.seed},"
        f" return {page.format_number(episode.total)}, {ending}"
    )
    return f"{caption}; {run.rank}" if run.rank else caption


def _motor_series(runs: Sequence[RunEpisode], motors: list[str]) -> list[MotorSeries]:
    """Return the series of every motor of every run.

    Args:
        runs: the runs.
        motors: names of the motors of all runs.
    """
    pairs = [
        (run, motor_index, motor)
        for run in runs
        for motor_index, motor in enumerate(motor_traces(run.known_episode))
    ]
    max_points = max(MAX_POINTS // 4, _MAX_EPISODE_POINTS // (10 * len(pairs)))
    # Both the points of each curve and those of the page are limited. All motors share a stride, so
    # that their points are at the same times.
    stride = max(-(-len(run.known_episode.trace["speed"]) // max_points) for run in runs)
    series = []
    for index, (run, motor_index, motor) in enumerate(pairs):
        names = run.known_episode.motors or ("motor",)
        prefix_parts = [run.name] * (len(runs) > 1) + [names[motor_index]] * (len(names) > 1)
        tags = f"run:{runs.index(run)}", f"motor:{motors.index(names[motor_index])}"
        prefix = f"{', '.join(prefix_parts)}: " if prefix_parts else ""
        series.append(
            MotorSeries(
                **vars(motor),
                label_prefix=prefix,
                color_index=index if len(pairs) > 1 else None,
                tags=tags,
                stride=stride,
            )
        )
    return series


_TIME = "time [s]"


def _motor_plots(lines: Sequence[MotorSeries]) -> list[Plot]:
    """Return the plots of torque, current, voltage, power and temperature of the motors."""
    ideal = [isinstance(line.actuator, Ideal) for line in lines]
    is_force, unit = all(ideal), "torque [N·m]"
    if any(ideal):
        unit = (
            "force [N] or torque [N·m]"
            if is_force
            else "torque [N·m], of the ideal actuator force [N]"
        )
    torque, error, current, voltage, power, temperature = ([] for _ in range(6))
    for line in lines:
        torque.append(line.curve("actual", line.actual, 1))
        if line.is_torque_controlled:
            torque.append(line.curve("desired", line.desired, 0, dashed=True))
            error.append(line.curve("desired minus actual", line.desired - line.actual, 4))
        if line.has("current"):
            current.append(line.curve("current", line.signals["current"], 1, held=False))
        if line.has("current", "reference_current"):
            current.append(
                line.curve("reference", line.signals["reference_current"], 0, dashed=True)
            )
        if line.has("voltage"):
            voltage.append(line.curve("voltage", line.signals["voltage"], 2))
        power.append(line.curve("mechanical", line.actual * line.turning, 1))
        if line.has("electrical_power", "copper_loss"):
            power.append(line.curve("electrical", line.signals["electrical_power"], 2, dashed=True))
            power.append(line.curve("heat in the winding", line.signals["copper_loss"], 4))
        elif line.has("current", "voltage"):
            amperes, volts = line.signals["current"], line.signals["voltage"]
            power.append(line.curve("electrical", volts * amperes, 2, dashed=True))
            if line.actuator.winding is not None:
                power.append(
                    line.curve("heat in the winding", line.actuator.winding[0] * amperes**2, 4)
                )
        if line.has("temperature") and np.ptp(line.signals["temperature"]) > 0.0:
            temperature.append(line.curve("winding", line.signals["temperature"], 4, held=False))
    title = "Force" if is_force else "Torque at the shaft"
    plots = [
        Plot(title, _TIME, unit, tuple(torque), clock=True, shades=_shades(lines, "saturated"))
    ]
    if any(np.ptp(curve.y) > 0.0 or curve.y.any() for curve in error):
        plots.append(Plot("Error: desired minus actual", _TIME, unit, tuple(error), clock=True))
    if current:
        shades = _shades(lines, "current_saturated", "temperature_saturated")
        plots.append(
            Plot(
                "Current and its reference",
                _TIME,
                "current [A]",
                tuple(current),
                clock=True,
                shades=shades,
            )
        )
    if voltage:
        curves = (*voltage, *_voltage_limits(lines, voltage))
        # Families with several limits have a signal for each. The only limit of the others is the
        # voltage.
        multi_limit_lines = [line for line in lines if line.has("voltage_saturated")]
        single_limit_lines = [
            line for line in lines if line.has("voltage") and not line.has("voltage_saturated")
        ]
        shades = _shades(multi_limit_lines, "voltage_saturated") + _shades(
            single_limit_lines, "saturated"
        )
        plots.append(
            Plot("Voltage and its limit", _TIME, "voltage [V]", curves, clock=True, shades=shades)
        )
    plots += _other_signals(lines)
    if not is_force:
        plots.append(Plot("Power and losses", _TIME, "power [W]", tuple(power), clock=True))
    if temperature:
        plots.append(Plot("Temperature", _TIME, "temperature [°C]", tuple(temperature), clock=True))
    return plots


def _shades(lines: Sequence[MotorSeries], *names: str) -> tuple[Shade, ...]:
    """Return the intervals in which the limits with these names were reached."""
    shades = []
    for line, name in itertools.product(lines, names):
        if line.has(name):
            times = line.timestep * np.arange(len(line.signals[name]) + 1)
            shades.append(
                Shade(
                    line.label_prefix + name.replace("_", " "),
                    flagged_intervals(times, line.signals[name]),
                    line.tags,
                )
            )
    return tuple(shades)


def _voltage_limits(lines: Sequence[MotorSeries], voltage_curves: Sequence[Curve]) -> list[Curve]:
    """Return lines at the supply voltages that are near the curves.

    A limit far away would flatten the curves.
    """
    highest = max(float(np.nanmax(np.abs(curve.y))) for curve in voltage_curves)
    tags_by_limit = {
        line.actuator.voltage_limit: line.tags for line in lines if line.has("voltage")
    }
    curves = []
    for limit, tags in tags_by_limit.items():
        # An unlimited supply is infinite and is not drawn either.
        if limit is not None and limit < max(4.0 * highest, 1e-9):
            ends = np.array([0.0, max(curve.x[-1] for curve in voltage_curves)])
            limit_tags = tags if len(tags_by_limit) > 1 else ()
            curves += [
                Curve(
                    f"{side}{limit:g} V",
                    ends,
                    np.full(2, float(f"{side}{limit}")),
                    True,
                    tags=limit_tags,
                )
                for side in "+-"
            ]
    return curves


_PLOTTED_SIGNALS = (
    *("current", "reference_current", "voltage", "temperature", "electrical_power", "copper_loss"),
    *("saturated", "voltage_saturated", "current_saturated", "temperature_saturated"),
)


def _other_signals(lines: Sequence[MotorSeries]) -> list[Plot]:
    """Return plots of signals that only some families have."""
    names = dict.fromkeys(
        name for line in lines for name in line.signals if name not in _PLOTTED_SIGNALS
    )
    plots = []
    for name in names:
        series = [line for line in lines if line.has(name)]
        unit = page.format_unit(series[0].actuator.SIGNAL_UNITS.get(name, "")) if series else ""
        curves = tuple(line.curve(name.replace("_", " "), line.signals[name], 3) for line in series)
        if series:
            title = name.replace("_", " ").capitalize()
            plots.append(
                Plot(title, _TIME, f"{name.replace('_', ' ')} [{unit}]", curves, clock=True)
            )
    return plots


def _run_plots(runs: Sequence[RunEpisode]) -> list[Plot]:
    """Return plots of the states and rewards of the runs."""
    plots: list[Plot] = []
    groups: dict[str, list[Curve]] = {}
    rewards = []
    has_several = len(runs) > 1
    for run_index, run in enumerate(runs):
        prefix = f"{run.name}: " if has_several else ""
        owner: CurveOwner = {
            "shared": run_index if has_several else None,
            "tags": (f"run:{run_index}",),
        }
        time = np.concatenate([[0.0], run.known_episode.time])
        counts: dict[str, int] = {}
        for index, name in enumerate(state_names(run.known_env)):
            unit = (re.search(r"\[(.*)\]", name) or [name, "1"])[1]
            count = counts[unit] = counts.get(unit, -1) + 1
            if count < _MAX_STATES:
                style: CurveStyle = {"colour": count, "dashed": has_several and count > 0, **owner}
                curve = Curve(
                    prefix + name.partition(" [")[0],
                    time,
                    run.known_episode.state[:, index],
                    **style,
                )
                groups.setdefault(unit, []).append(curve)
        held = np.append(run.known_episode.reward, run.known_episode.reward[-1])
        rewards.append(Curve(f"{prefix}reward", time, held, style="step", colour=5, **owner))
    for unit, curves in groups.items():
        names = list(
            dict.fromkeys(curve.label.rpartition(": ")[2].replace("_", " ") for curve in curves)
        )
        title = (
            f"State: {', '.join(names)}"
            if len(names) < 4
            else f"States {'without a unit' if unit == '1' else f'in {unit}'}"
        )
        plots.append(Plot(title, _TIME, f"state [{unit}]", tuple(curves), clock=True))
    plots.append(Plot("Reward of each step", _TIME, "reward", tuple(rewards), clock=True))
    return plots
