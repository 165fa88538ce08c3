"""The live view in a browser: the scene, what can be done to it, what the motors do, and what they are made of."""

import functools
import itertools
import queue
import time
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import trimesh
from viser import uplot

from codrl_mj.viz.replay.scene import (
    TRIANGLES,
    Shape,
    first_view,
    mesh,
    read_poses,
    shapes,
    thinned,
)
from codrl_mj.viz.view.local import LocalServer
from codrl_mj.viz.view.session import Control, Session, controls

_FRAME = 1 / 30  # s, of wall clock
_PLOT_EVERY = 0.2  # s, of wall clock
_POINTS = 400
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7")  # colour-blind safe (Okabe and Ito)
_AXES = {"x": 0, "y": 1, "z": 2}
_WANTED = ("desired", "reference")  # signals that are drawn first
_HUGE = 1e30  # what is beyond it has diverged
_DELAY_STEPS = 5  # environment steps, where the slider of the delay ends
_SUPPLY = 48.0  # V, where that of an unlimited voltage ends
_FLAT = ("box", "cylinder", "mesh", "plane")


class Browser:
    """Serves a session until it is closed."""

    def __init__(self, session: Session, port: int, title: str) -> None:
        """Begin to serve a session, which from now on this alone touches, at a port or the next free one."""
        self.session = session
        self.playing, self._speed, self._budget, self._real = True, 1.0, 0.0, 1.0
        self._deeds: queue.SimpleQueue[tuple[Any, Callable[[], None]]] = queue.SimpleQueue()
        self._refusal = ""
        self.server = LocalServer(port)
        self.server.gui.set_panel_label(title)
        self._send_scene()
        self._build()
        self.server.gui.configure_theme(
            show_logo=False, show_share_button=False, control_width="medium"
        )
        self._move()

    @property
    def url(self) -> str:
        """Where it is to be seen."""
        return f"http://{self.server.get_host()}:{self.server.get_port()}"

    def run(self, until: Callable[[], bool] = lambda: False) -> None:
        """Simulate in real time until told otherwise."""
        began = last = time.perf_counter()
        plotted, simulated, since = 0.0, 0.0, began
        while not until():
            now = time.perf_counter()
            self.do()
            simulated += self._advance(now - last)
            last = now
            self._move()
            if now - plotted > _PLOT_EVERY:
                plotted = now
                self._plot()
            if now - since > 1.0:
                self._real, simulated, since = simulated / (now - since), 0.0, now
            self._say()
            time.sleep(max(0.0, _FRAME - (time.perf_counter() - now)))

    def do(self) -> None:
        """Do what was asked for since; of several settings of one field the last."""
        asked: dict[Any, Callable[[], None]] = {}
        while not self._deeds.empty():
            what, deed = self._deeds.get()
            asked.pop(what, None)
            asked[what] = deed
        for deed in asked.values():
            try:
                deed()
                self._refusal = ""
            except (ValueError, OSError) as error:
                self._refusal = " ".join(str(error).split())

    def close(self) -> None:
        """End the server."""
        self.server.stop()

    # -- the scene ---------------------------------------------------------------------------------------------

    def _send_scene(self) -> None:
        """Send the model to whoever looks."""
        model, scene = self.session.model, self.server.scene
        self._shapes, self._poses = shapes(model), np.empty((model.nbody, 7))
        moving = {body for body in range(model.nbody) if model.body_weldid[body]}
        read_poses(self.session.data, self._shapes, self._poses)
        cameras = [model.camera(index).name for index in range(model.ncam)]
        own = hasattr(self.session.env.unwrapped, "physics") and "fixed" in cameras
        view = first_view(model, self._shapes, self._poses, moving, "fixed" if own else None)
        self._frames: dict[int, Any] = {}
        few = {
            one.mesh: thinned(*mesh(model, *one.mesh), TRIANGLES // 4)
            for one in self._shapes
            if one.mesh
        }
        with self.server.atomic():
            scene.set_up_direction("+z")
            scene.world_axes.visible = False
            for body in sorted({one.body for one in self._shapes}):
                position, quaternion = self._poses[body, :3], self._poses[body, 3:]
                frame = scene.add_frame(
                    f"/{body}", show_axes=False, position=position, wxyz=quaternion
                )
                if body in moving:
                    self._frames[body] = frame
            for index, one in enumerate(self._shapes):
                vertices, triangles = few[one.mesh] if one.mesh else _triangles(one, view.extent)
                opacity = one.colour[3]
                scene.add_mesh_simple(
                    f"/{one.body}/{index}",
                    vertices,
                    triangles,
                    color=tuple(round(255 * part) for part in one.colour[:3]),
                    opacity=opacity if opacity < 1 else None,
                    flat_shading=one.kind in _FLAT,
                    side="double" if one.kind in ("mesh", "plane") else "front",
                    cast_shadow=one.kind != "plane",
                    position=one.position,
                    wxyz=one.orientation,
                )
        first = self.server.initial_camera
        first.position, first.look_at, first.up = view.eye, view.at, np.array([0.0, 0.0, 1.0])
        first.fov = np.radians(view.fovy)

    def _move(self) -> None:
        """Move the bodies to where they are."""
        read_poses(self.session.data, self._shapes, self._poses)
        with self.server.atomic():
            for body, frame in self._frames.items():
                frame.position, frame.wxyz = self._poses[body, :3], self._poses[body, 3:]

    # -- a frame -----------------------------------------------------------------------------------------------

    def _advance(self, elapsed: float) -> float:
        """Simulate as much as is due, and say how much that was [s]; give up what a frame has no time for."""
        if not self.playing:
            self._budget = 0.0
            return 0.0
        step, done, began = self.session.recorder.step_duration, 0.0, time.perf_counter()
        self._budget += elapsed * self._speed
        while self._budget >= step:
            if not self.session.step():
                self._budget = 0.0
                break
            self._budget -= step
            done += step
            if time.perf_counter() - began > 2 * _FRAME:
                self._budget = min(self._budget, step)
                break
        return done

    def _say(self) -> None:
        session = self.session
        state = "waits" if session.waits else "plays" if self.playing else "paused"
        ended = f", {session.ended}" if session.ended else ""
        text = (
            f"**{session.time:.2f} s** · return {session.total:.1f}{ended} · {state},"
            f" {self._real:.2f} × real time"
        )
        if self._status.content != text:
            self._status.content = text
        problem = self._refusal or session.problem or ""
        title = "Not simulated" if session.waits else "Refused"
        shown = f"⚠ **{title}:** {_plain(problem)}" if problem else ""
        if self._problem.content != shown:
            self._problem.content, self._problem.visible = shown, bool(shown)
            for client in (
                self.server.get_clients().values() if shown else ()
            ):  # the panel may be scrolled away from it
                client.add_notification(title, problem, color="red", auto_close_seconds=8.0)

    def _plot(self) -> None:
        kept = list(self.session.signals)
        if not kept:
            return
        kept = kept[:: max(1, len(kept) // _POINTS)]
        motor = (
            self.session.recorder.motor_names.index(self._motor.value)
            if self._motor is not None
            else 0
        )
        times = np.array([when for when, _ in kept])
        values = np.array([row[motor] for _, row in kept])
        for columns, handle in self._plots:
            handle.data = (times, *drawable(values[:, columns]).T)

    # -- what is on the panel ------------------------------------------------------------------------------------

    def _build(self) -> None:
        gui, session = self.server.gui, self.session
        self._problem = gui.add_markdown("", visible=False)
        self._status = gui.add_markdown("…")
        deeds = {"Play or pause": self._toggle, "Step": self._single, "Reset": session.reset}
        buttons = gui.add_button_group("", tuple(deeds), hint="keys P, N and R")
        buttons.on_click(lambda _: self._ask(object(), deeds[buttons.value]))
        for (label, deed), key in zip(deeds.items(), ("P", "N", "R"), strict=True):
            gui.add_command(label, hotkey=key).on_trigger(
                lambda _, deed=deed: self._ask(object(), deed)
            )
        policy = gui.add_dropdown("policy", tuple(session.policies), initial_value=session.chosen)
        policy.on_update(lambda _: self._ask("policy", lambda: session.choose(policy.value)))
        speed = gui.add_slider("speed", 0.05, 4.0, 0.05, 1.0)
        speed.on_update(lambda _: setattr(self, "_speed", speed.value))
        again = gui.add_checkbox(
            "begin anew at the end", True, hint="also at the time limit; otherwise it goes on"
        )
        again.on_update(lambda _: setattr(session, "again", again.value))
        self._pushes()
        self._signals()
        for (
            pattern,
            actuator,
        ) in (
            session.config.actuators_by_name.items()
        ):  # a folder for each part of what drives a motor
            several = f" {pattern}" if len(session.config.actuators_by_name) > 1 else ""
            own = actuator.family or type(actuator).__name__
            change, found = (
                functools.partial(session.set_actuator, pattern),
                controls(actuator, _SUPPLY),
            )
            for part, fields in itertools.groupby(
                found,
                lambda one: one.path[0] if len(one.path) > 1 else own,  # noqa: B023
            ):
                self._settings(f"{part}{several}", fields, change)
            if not found:
                gui.add_markdown(f"Nothing can be set of {own}{several}: begin with `--actuator`.")
        disturbances = session.config.disturbances
        ends = {"command_delay": _DELAY_STEPS * session.recorder.step_duration}
        self._settings(
            "delay and disturbances", controls(disturbances, ends=ends), session.set_disturbance
        )

    def _pushes(self) -> None:
        gui, session = self.server.gui, self.session
        if not session.bodies:
            return
        with gui.add_folder("push"):
            body = gui.add_dropdown("body", tuple(session.bodies))
            axis = gui.add_dropdown("along", tuple(_AXES))
            weight = float(session.model.body_mass.sum() * 9.81)
            force = gui.add_slider(
                "force [N]", 0.0, _round(5 * weight), _round(weight / 40), _round(weight)
            )

            signs = {"Push back": -1.0, "Push forth": 1.0}
            buttons = gui.add_button_group("", tuple(signs))

            def push() -> None:
                session.push(body.value, signs[buttons.value] * force.value, _AXES[axis.value])

            buttons.on_click(lambda _: self._ask(object(), push))

    def _signals(self) -> None:
        gui, session = self.server.gui, self.session
        self._plots: list[tuple[list[int], Any]] = []
        self._motor: Any = None
        units: dict[str, str] = {
            "desired_force": "force, torque at the joint",
            "actual_force": "force, torque at the joint",
        }
        for actuator in session.config.actuators_by_name.values():
            units |= {
                name: f"{name.split('_')[-1]} [{unit}]"
                for name, unit in actuator.SIGNAL_UNITS.items()
            }
        groups: dict[str, list[str]] = {}
        for name in sorted(
            session.recorder.trace_names, key=lambda name: not name.startswith(_WANTED)
        ):
            if name in units:
                groups.setdefault(units[name], []).append(name)
        with gui.add_folder("signals"):
            if len(session.recorder.motor_names) > 1:
                self._motor = gui.add_dropdown("motor", tuple(session.recorder.motor_names))
            for title, names in groups.items():
                series = [
                    uplot.Series(label=name.replace("_", " "), stroke=colour, width=2)
                    for name, colour in zip(names, itertools.cycle(_COLOURS), strict=False)
                ]
                handle = gui.add_uplot(
                    tuple(np.zeros(2) for _ in range(len(names) + 1)),
                    (uplot.Series(label="t [s]"), *series),
                    title=title,
                    scales={"x": uplot.Scale(time=False, auto=True)},
                    height=170,
                )
                self._plots.append(
                    ([session.recorder.trace_names.index(name) for name in names], handle)
                )

    def _settings(
        self, title: str, found: Iterable[Control], change: Callable[[tuple[str, ...], Any], None]
    ) -> None:
        """A folder with what has a slider, and within it one with what has to be typed."""
        gui, found = self.server.gui, list(found)
        slid = [
            one
            for one in found
            if one.high is not None or one.options or isinstance(one.value, bool)
        ]
        typed = [one for one in found if one not in slid]
        with gui.add_folder(title, expand_by_default=False):
            for one in slid:
                self._field(one, change)
            if typed:
                with gui.add_folder("more", expand_by_default=False):
                    for one in typed:
                        self._field(one, change)

    def _field(self, one: Control, change: Callable[[tuple[str, ...], Any], None]) -> None:
        gui, hint = self.server.gui, one.about
        label = one.path[-1].replace("_", " ") + (f" [{one.unit}]" if one.unit else "")
        handle: Any
        if one.options:
            handle = gui.add_dropdown(label, one.options, initial_value=one.value, hint=hint)
        elif isinstance(one.value, bool):
            handle = gui.add_checkbox(label, one.value, hint=hint)
        elif one.high is None or one.low is None:
            handle = gui.add_number(label, one.value, min=one.low, hint=hint)
        elif isinstance(one.value, int):
            handle = gui.add_slider(label, int(one.low), int(one.high), 1, one.value, hint=hint)
        else:
            low, high = _round(one.low), _round(one.high)
            end = "; at its end without a limit" if one.endless else ""
            value = high if one.endless else min(max(float(one.value), low), high)
            handle = gui.add_slider(
                label, low, high, _round((high - low) / 200), value, hint=(hint or "") + end or None
            )
        handle.on_update(
            lambda _: self._ask(one.path, lambda: change(one.path, one.parsed(handle.value)))
        )

    # -- what is asked for -----------------------------------------------------------------------------------------

    def _ask(self, what: Any, deed: Callable[[], None]) -> None:
        """Have something done between two frames: callbacks come from threads of viser's."""
        self._deeds.put((what, deed))

    def _toggle(self) -> None:
        self.playing = not self.playing

    def _single(self) -> None:
        if self.playing:
            self._toggle()
        self.session.step()


def _triangles(one: Shape, extent: float) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles of a shape that is no mesh of the model's."""
    size = one.size
    if one.kind == "plane":
        x, y = (half if half > 0 else 20 * extent for half in size[:2])
        return np.array([[-x, -y, 0], [x, -y, 0], [x, y, 0], [-x, y, 0]]), np.array(
            [[0, 1, 2], [0, 2, 3]]
        )
    if one.kind == "box":
        made = trimesh.creation.box(2 * np.array(size))
    elif one.kind == "ellipsoid":
        made = trimesh.creation.icosphere(subdivisions=3).apply_scale(size)
    elif one.kind == "capsule":
        made = trimesh.creation.capsule(height=2 * size[1], radius=size[0])
    else:
        made = trimesh.creation.cylinder(radius=size[0], height=2 * size[1], sections=48)
    return np.asarray(made.vertices), np.asarray(made.faces)


def drawable(values: np.ndarray) -> np.ndarray:
    """Values of a plot, of any shape, as uPlot can draw them: finite, and equal or apart by 1e-6 of the largest.

    Where all differ by rounding errors alone, its search for ticks does not end before the memory
    does.
    """
    values = np.nan_to_num(values, posinf=_HUGE, neginf=-_HUGE).clip(-_HUGE, _HUGE)
    step = 1e-6 * np.abs(values).max(initial=0.0)
    return np.round(values / step) * step if step > np.finfo(float).tiny else np.zeros_like(values)


def _round(value: float) -> float:
    """To three digits: a slider shows as many as its ends have."""
    return float(f"{value:.3g}")


def _plain(text: str) -> str:
    """Text whose signs are no Markdown."""
    return "".join(f"\\{sign}" if sign in "\\`*_{}[]<>()#+-!|~" else sign for sign in text)
