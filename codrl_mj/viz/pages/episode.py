"""One episode of each of some runs: film and plots on one clock."""

import dataclasses
import itertools
import re
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from markupsafe import Markup

from codrl_mj.actuators import Ideal
from codrl_mj.evaluation import run_episodes
from codrl_mj.evaluation.evaluate import MotorTrace, motor_traces
from codrl_mj.viz.films.film import Clip, clip, record
from codrl_mj.viz.pages import page
from codrl_mj.viz.pages.diagrams import episode_diagram
from codrl_mj.viz.pages.plots import POINTS, Curve, Plot, Shade, spans

_SIZE = 480, 360
_BUDGET = 400_000
"""Points of all curves of an episode: two megabytes."""
_MANY = 3
"""Of more motors than this only one is shown at first."""
_MOST_STATES = 12
"""Lines of a plot of states."""


class Shown(NamedTuple):
    """A run, and an episode of it as far as there is one."""

    name: str
    """The run's."""
    env: Any
    """The `EnvConfig` that it runs in; None where that cannot be read."""
    episode: Any
    """What happened, an `Episode`; None: `problem`."""
    film: Clip | None
    """The scene; None: `problem`."""
    problem: str | None
    """Why there is no episode, or no film of it."""
    seed: int
    """Of the episode."""
    best: bool = False
    """Whether the policy of its best evaluation acts."""
    summary: Any = None
    """What its folder says: a `RunSummary`."""
    rank: str = ""
    """How its return compares with those of the run's evaluation."""


def show(name: str, env: Any, policy: Any, seed: int, filmed: bool = True) -> Shown:
    """Run an episode in a run's environment, an `EnvConfig`, and film it where that works."""
    episode, film, problem = None, None, None if filmed else "none was asked for"
    if filmed:
        try:
            panel = record(policy, env, seed, *_SIZE)
            episode = panel.episode
            film = clip(panel, *_SIZE)
        except (
            Exception
        ) as error:  # each renderer raises its own kind, and so do libraries that are not installed
            problem = f"{type(error).__name__}: {error}"
    return Shown(
        name, env, episode or run_episodes(policy, env.make, 1, seed)[0], film, problem, seed
    )


@dataclasses.dataclass(frozen=True)
class _MotorLine(MotorTrace):
    """What one motor of one run did; what its curves are called, and when they are shown."""

    before: str
    """Of their labels."""
    place: int | None
    """Among all of them; None where it is the only one. Its colour beside others."""
    tags: tuple[str, ...]
    stride: int
    """Every so many integration steps are drawn."""

    @property
    def turning(self) -> np.ndarray:
        """Velocity of the shaft at the end of each integration step [rad/s]."""
        return self.speed[1:] / self.actuator.arm_radius

    def has(self, *names: str) -> bool:
        """Whether its family has these signals."""
        return not isinstance(self.actuator, Ideal) and set(names) <= self.signals.keys()

    def curve(
        self, label: str, values: np.ndarray, colour: int, held: bool = True, dashed: bool = False
    ) -> Curve:
        """A curve over the integration steps; what is held begins with them, what is not is at their ends."""
        kept = slice(None, None, self.stride)
        values = np.asarray(values, dtype=float)
        time = self.timestep * (np.arange(len(values)) + (not held))
        if held:
            time, values = (
                np.append(time[kept], time[-1] + self.timestep),
                np.append(values[kept], values[-1]),
            )
        else:
            time, values = time[kept], values[kept]
        style: Any = {"style": "step" if held else "line", "colour": colour, "dashed": dashed}
        return Curve(self.before + label, time, values, shared=self.place, tags=self.tags, **style)


def episode_section(shown: Sequence[Shown], joined: Iterable[Markup] = ()) -> Markup:
    """Films, controls and plots of some episodes side by side, and what else follows the clock (`page.clocked`)."""
    motors = list(dict.fromkeys(name for one in shown for name in one.episode.motors or ("motor",)))
    lines = _lines(shown, motors)
    end = max(float(one.episode.time[-1]) for one in shown)
    films = [
        page.part("film", _caption(one, len(shown) > 1), *one.film)
        for one in shown
        if one.film is not None
    ]
    boxes = (
        [page.part("selector", "Runs", "run", [one.name for one in shown], None)]
        if len(shown) > 1
        else []
    )
    if len(motors) > 1:
        boxes.append(
            page.part("selector", "Motors", "motor", motors, 0 if len(motors) > _MANY else None)
        )
    notes = [
        page.note(f"No film of {one.name}: {one.problem}") for one in shown if one.film is None
    ]
    stage = [
        *notes,
        Markup('<div class="pinned">{}{}</div>').format(
            Markup('<div class="films">{}</div>').format(page.joined(films)) if films else "",
            page.part(
                "transport", f"{end:.6g}", f"{min(float(one.episode.time[0]) for one in shown):.6g}"
            ),
        ),
        Markup('<div class="selectors">{}</div>').format(page.joined(boxes)) if boxes else Markup(),
        *joined,
    ]
    diagram = episode_diagram(lines)
    if diagram is not None:
        stage.append(page.plot(diagram))
    right = [page.plot(one, low=True) for one in (*_motor_plots(lines), *_run_plots(shown))]
    ends = [page.paragraph(_caption(one, True), "soft") for one in shown] if not films else []
    if lines and lines[0].stride > 1:
        ends.append(
            page.paragraph(f"Plots have every {lines[0].stride}th integration step.", "soft")
        )
    return page.joined(
        (
            page.paragraph(
                "Film and plots share a clock: play the film, or drag in any plot over time."
                " Torque, current and speed are the motor's own, at its shaft."
            ),
            *ends,
            Markup(
                '<div class="episode"><div class="stage">{}</div><div class="stack">{}</div></div>'
            ).format(page.joined(stage), page.joined(right)),
        )
    )


def _caption(one: Shown, named: bool) -> str:
    episode = one.episode
    over = f"{'ended' if episode.terminated else 'time limit'} at {episode.time[-1]:.2f} s"
    found = (
        f"{one.name + ': ' if named else ''}seed {one.seed}, return {page.number(episode.total)},"
        f" {over}"
    )
    return f"{found}; {one.rank}" if one.rank else found


def _lines(shown: Sequence[Shown], motors: list[str]) -> list[_MotorLine]:
    """Every motor of every run; by the names of all."""
    pairs = [
        (one, number, motor) for one in shown for number, motor in enumerate(motor_traces(one.episode))
    ]
    most = max(POINTS // 4, _BUDGET // (10 * len(pairs)))
    stride = max(-(-len(one.episode.trace["speed"]) // most) for one in shown)
    made = []
    for place, (one, number, motor) in enumerate(pairs):
        names = one.episode.motors or ("motor",)
        words = [one.name] * (len(shown) > 1) + [names[number]] * (len(names) > 1)
        tags = f"run:{shown.index(one)}", f"motor:{motors.index(names[number])}"
        before = f"{', '.join(words)}: " if words else ""
        made.append(
            _MotorLine(
                **vars(motor),
                before=before,
                place=place if len(pairs) > 1 else None,
                tags=tags,
                stride=stride,
            )
        )
    return made


_TIME = "time [s]"


def _motor_plots(lines: Sequence[_MotorLine]) -> list[Plot]:
    """What the motors did."""
    ideal = [isinstance(line.actuator, Ideal) for line in lines]
    force, unit = all(ideal), "torque [N·m]"
    if any(ideal):
        unit = (
            "force [N] or torque [N·m]"
            if force
            else "torque [N·m], of the ideal actuator force [N]"
        )
    torque, error, current, voltage, power, warmth = ([] for _ in range(6))  # type: ignore[var-annotated]
    for line in lines:
        torque.append(line.curve("actual", line.actual, 1))
        if line.is_torque_controlled:
            torque.append(line.curve("desired", line.desired, 0, dashed=True))
            error.append(line.curve("desired less actual", line.desired - line.actual, 4))
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
            warmth.append(line.curve("winding", line.signals["temperature"], 4, held=False))
    title = "Force" if force else "Torque at the shaft"
    found = [
        Plot(title, _TIME, unit, tuple(torque), clock=True, shades=_shades(lines, "saturated"))
    ]
    if any(np.ptp(curve.y) > 0.0 or curve.y.any() for curve in error):
        found.append(Plot("Error: desired less actual", _TIME, unit, tuple(error), clock=True))
    if current:
        shades = _shades(lines, "current_saturated", "temperature_saturated")
        found.append(
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
        split = [
            line for line in lines if line.has("voltage_saturated")
        ]  # the only limit of others is the voltage's
        others = [
            line for line in lines if line.has("voltage") and not line.has("voltage_saturated")
        ]
        shades = _shades(split, "voltage_saturated") + _shades(others, "saturated")
        found.append(
            Plot("Voltage and its limit", _TIME, "voltage [V]", curves, clock=True, shades=shades)
        )
    found += _other_signals(lines)
    if not force:
        found.append(Plot("Power and losses", _TIME, "power [W]", tuple(power), clock=True))
    if warmth:
        found.append(Plot("Temperature", _TIME, "temperature [°C]", tuple(warmth), clock=True))
    return found


def _shades(lines: Sequence[_MotorLine], *names: str) -> tuple[Shade, ...]:
    """Where the limits by these names were met."""
    found = []
    for line, name in itertools.product(lines, names):
        if line.has(name):
            times = line.timestep * np.arange(len(line.signals[name]) + 1)
            found.append(
                Shade(
                    line.before + name.replace("_", " "),
                    spans(times, line.signals[name]),
                    line.tags,
                )
            )
    return tuple(found)


def _voltage_limits(lines: Sequence[_MotorLine], drawn: Sequence[Curve]) -> list[Curve]:
    """The supply's voltages, where they come near: a limit far off would press the curve flat."""
    highest = max(float(np.nanmax(np.abs(curve.y))) for curve in drawn)
    each = {line.actuator.voltage_limit: line.tags for line in lines if line.has("voltage")}
    found = []
    for limit, tags in each.items():
        if limit is not None and limit < max(4.0 * highest, 1e-9):
            ends = np.array([0.0, max(curve.x[-1] for curve in drawn)])
            own = tags if len(each) > 1 else ()
            found += [
                Curve(
                    f"{side}{limit:g} V", ends, np.full(2, float(f"{side}{limit}")), True, tags=own
                )
                for side in "+-"
            ]
    return found


_KNOWN = (
    *("current", "reference_current", "voltage", "temperature", "electrical_power", "copper_loss"),
    *("saturated", "voltage_saturated", "current_saturated", "temperature_saturated"),
)


def _other_signals(lines: Sequence[_MotorLine]) -> list[Plot]:
    """Signals that only some families have."""
    names = dict.fromkeys(name for line in lines for name in line.signals if name not in _KNOWN)
    found = []
    for name in names:
        own = [line for line in lines if line.has(name)]
        unit = page.unit(own[0].actuator.SIGNAL_UNITS.get(name, "")) if own else ""
        curves = tuple(line.curve(name.replace("_", " "), line.signals[name], 3) for line in own)
        if own:
            title = name.replace("_", " ").capitalize()
            found.append(
                Plot(title, _TIME, f"{name.replace('_', ' ')} [{unit}]", curves, clock=True)
            )
    return found


def _run_plots(shown: Sequence[Shown]) -> list[Plot]:
    """States and reward of the runs."""
    found: list[Plot] = []
    groups: dict[str, list[Curve]] = {}
    rewards = []
    several = len(shown) > 1
    for place, one in enumerate(shown):
        before = f"{one.name}: " if several else ""
        own: Any = {"shared": place if several else None, "tags": (f"run:{place}",)}
        time = np.concatenate([[0.0], one.episode.time])
        counts: dict[str, int] = {}
        for index, name in enumerate(one.env.world.state_names(one.env)):
            unit = (re.search(r"\[(.*)\]", name) or [name, "1"])[1]
            count = counts[unit] = counts.get(unit, -1) + 1
            if count < _MOST_STATES:
                more = {"colour": count, "dashed": several and count > 0, **own}
                curve = Curve(
                    before + name.partition(" [")[0], time, one.episode.state[:, index], **more
                )
                groups.setdefault(unit, []).append(curve)
        held = np.append(one.episode.reward, one.episode.reward[-1])
        rewards.append(Curve(f"{before}reward", time, held, style="step", colour=5, **own))
    for unit, curves in groups.items():
        names = list(
            dict.fromkeys(curve.label.rpartition(": ")[2].replace("_", " ") for curve in curves)
        )
        title = (
            f"State: {', '.join(names)}"
            if len(names) < 4
            else f"States {'without a unit' if unit == '1' else f'in {unit}'}"
        )
        found.append(Plot(title, _TIME, f"state [{unit}]", tuple(curves), clock=True))
    found.append(Plot("Reward of each step", _TIME, "reward", tuple(rewards), clock=True))
    return found
