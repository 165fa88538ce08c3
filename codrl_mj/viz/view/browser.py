"""Live view in a browser: scene, controls, signals of the motors, and their settings."""

import functools
import itertools
import queue
import time
from collections.abc import Callable, Hashable, Iterable

import numpy as np
import trimesh
import viser
from viser import uplot

from codrl_mj.actuators.parameters import FieldValue
from codrl_mj.viz.replay.scene import (
    TRIANGLES,
    Shape,
    initial_view,
    read_mesh,
    read_poses,
    simplify_mesh,
    visible_shapes,
)
from codrl_mj.viz.view.local import LocalServer
from codrl_mj.viz.view.session import Control, Session, controls

_FRAME_TIME = 1 / 30  # s, wall clock
_PLOT_INTERVAL = 0.2  # s, wall clock
_MAX_POINTS = 400
_COLORS = (
    "#0072B2",
    "#D55E00",
    "#009E73",
    "#CC79A7",
)  # distinguishable for color-blind people (Okabe and Ito)
_AXES = {"x": 0, "y": 1, "z": 2}
# Signals whose names start with these are plotted first.
_FIRST_SIGNALS = ("desired", "reference")
# A larger value has diverged.
_MAX_VALUE = 1e30
# End of the slider of the delay [environment steps].
_DELAY_STEPS = 5
# End of the slider of an unlimited voltage [V].
_MAX_SUPPLY = 48.0
_FLAT_KINDS = ("box", "cylinder", "mesh", "plane")
ChangeSetting = Callable[[tuple[str, ...], FieldValue], None]
"""Function (path, value) that sets a field of the session's settings."""


class Browser:
    """Server of a session, until it is closed."""

    def __init__(self, session: Session, port: int, title: str) -> None:
        """Start to serve a session at a port, or at the next free one.

        From now on only this object may use the session.
        """
        self.session = session
        self.playing, self._speed, self._budget, self._real_time_factor = True, 1.0, 0.0, 1.0
        self._pending: queue.SimpleQueue[tuple[Hashable, Callable[[], None]]] = queue.SimpleQueue()
        self._refusal = ""
        self.server = LocalServer(port)
        self.server.gui.set_panel_label(title)
        self._send_scene()
        self._build_panel()
        self.server.gui.configure_theme(
            show_logo=False, show_share_button=False, control_width="medium"
        )
        self._update_frames()

    @property
    def url(self) -> str:
        """Address of the page."""
        return f"http://{self.server.get_host()}:{self.server.get_port()}"

    def run(self, should_stop: Callable[[], bool] = lambda: False) -> None:
        """Simulate in real time until a function returns True."""
        start = last = time.perf_counter()
        plotted, simulated, rate_start = 0.0, 0.0, start
        while not should_stop():
            now = time.perf_counter()
            self.run_pending()
            simulated += self._advance(now - last)
            last = now
            self._update_frames()
            if now - plotted > _PLOT_INTERVAL:
                plotted = now
                self._update_plots()
            if now - rate_start > 1.0:
                self._real_time_factor = simulated / (now - rate_start)
                simulated = 0.0
                rate_start = now
            self._update_status()
            time.sleep(max(0.0, _FRAME_TIME - (time.perf_counter() - now)))

    def run_pending(self) -> None:
        """Execute the pending requests; of several requests for one field, only the last."""
        requests: dict[Hashable, Callable[[], None]] = {}
        while not self._pending.empty():
            key, action = self._pending.get()
            requests.pop(key, None)
            requests[key] = action
        for action in requests.values():
            try:
                action()
                self._refusal = ""
            except (ValueError, OSError) as error:
                self._refusal = " ".join(str(error).split())

    def close(self) -> None:
        """Stop the server."""
        self.server.stop()

    # -- scene ------------------------------------------------------------------------------------

    def _send_scene(self) -> None:
        """Send the model to the clients."""
        model, scene = self.session.model, self.server.scene
        self._shapes, self._poses = visible_shapes(model), np.empty((model.nbody, 7))
        moving = {body for body in range(model.nbody) if model.body_weldid[body]}
        read_poses(self.session.data, self._shapes, self._poses)
        cameras = [model.camera(index).name for index in range(model.ncam)]
        is_task = hasattr(self.session.env.unwrapped, "physics") and "fixed" in cameras
        view = initial_view(model, self._shapes, self._poses, moving, "fixed" if is_task else None)
        self._frames: dict[int, viser.FrameHandle] = {}
        meshes = {
            shape.mesh: simplify_mesh(*read_mesh(model, *shape.mesh), TRIANGLES // 4)
            for shape in self._shapes
            if shape.mesh
        }
        with self.server.atomic():
            scene.set_up_direction("+z")
            scene.world_axes.visible = False
            for body in sorted({shape.body for shape in self._shapes}):
                position, quaternion = self._poses[body, :3], self._poses[body, 3:]
                frame = scene.add_frame(
                    f"/{body}", show_axes=False, position=position, wxyz=quaternion
                )
                if body in moving:
                    self._frames[body] = frame
            for index, shape in enumerate(self._shapes):
                vertices, triangles = (
                    meshes[shape.mesh] if shape.mesh else _triangles(shape, view.extent)
                )
                opacity = shape.colour[3]
                scene.add_mesh_simple(
                    f"/{shape.body}/{index}",
                    vertices,
                    triangles,
                    color=tuple(round(255 * part) for part in shape.colour[:3]),
                    opacity=opacity if opacity < 1 else None,
                    flat_shading=shape.kind in _FLAT_KINDS,
                    side="double" if shape.kind in ("mesh", "plane") else "front",
                    cast_shadow=shape.kind != "plane",
                    position=shape.position,
                    wxyz=shape.orientation,
                )
        initial_camera = self.server.initial_camera
        initial_camera.position = view.eye
        initial_camera.look_at = view.target
        initial_camera.up = np.array([0.0, 0.0, 1.0])
        initial_camera.fov = np.radians(view.fovy)

    def _update_frames(self) -> None:
        """Move the bodies to their current poses."""
        read_poses(self.session.data, self._shapes, self._poses)
        with self.server.atomic():
            for body, frame in self._frames.items():
                frame.position, frame.wxyz = self._poses[body, :3], self._poses[body, 3:]

    # -- one frame --------------------------------------------------------------------------------

    def _advance(self, elapsed: float) -> float:
        """Simulate the time that is due, and return how much was simulated [s].

        Time that does not fit into a frame is dropped.
        """
        if not self.playing:
            self._budget = 0.0
            return 0.0
        step, simulated, start = self.session.recorder.step_duration, 0.0, time.perf_counter()
        # Environment steps are of fixed length: time that is not enough for a step is kept for the
        # next frame.
        self._budget += elapsed * self._speed
        while self._budget >= step:
            if not self.session.step():
                self._budget = 0.0
                break
            self._budget -= step
            simulated += step
            # The simulation is slower than real time: keep the page responsive, and drop the rest.
            if time.perf_counter() - start > 2 * _FRAME_TIME:
                self._budget = min(self._budget, step)
                break
        return simulated

    def _update_status(self) -> None:
        session = self.session
        state = "waits" if session.is_stopped else "plays" if self.playing else "paused"
        ended = f", {session.ended}" if session.ended else ""
        text = (
            f"**{session.time:.2f} s** · return {session.total:.1f}{ended} · {state},"
            f" {self._real_time_factor:.2f} × real time"
        )
        if self._status.content != text:
            self._status.content = text
        problem = self._refusal or session.problem or ""
        title = "Not simulated" if session.is_stopped else "Refused"
        text_shown = f"⚠ **{title}:** {_escape_markdown(problem)}" if problem else ""
        if self._problem.content != text_shown:
            self._problem.content, self._problem.visible = text_shown, bool(text_shown)
            # The panel may be scrolled so that the text is not visible: show a notification too.
            for client in self.server.get_clients().values() if text_shown else ():
                client.add_notification(title, problem, color="red", auto_close_seconds=8.0)

    def _update_plots(self) -> None:
        rows = list(self.session.signals)
        if not rows:
            return
        # uPlot redraws all points five times per second: show every k-th row only.
        rows = rows[:: max(1, len(rows) // _MAX_POINTS)]
        motor = (
            self.session.recorder.motor_names.index(self._motor.value)
            if self._motor is not None
            else 0
        )
        times = np.array([row_time for row_time, _ in rows])
        values = np.array([row[motor] for _, row in rows])
        for columns, handle in self._plots:
            handle.data = (times, *limit_for_uplot(values[:, columns]).T)

    # -- panel ------------------------------------------------------------------------------------

    def _build_panel(self) -> None:
        gui, session = self.server.gui, self.session
        self._problem = gui.add_markdown("", visible=False)
        self._status = gui.add_markdown("…")
        actions = {"Play or pause": self._toggle, "Step": self._single_step, "Reset": session.reset}
        buttons = gui.add_button_group("", tuple(actions), hint="keys P, N and R")
        buttons.on_click(lambda _: self._enqueue(object(), actions[buttons.value]))
        for (label, action), key in zip(actions.items(), ("P", "N", "R"), strict=True):
            gui.add_command(label, hotkey=key).on_trigger(
                lambda _, action=action: self._enqueue(object(), action)
            )
        policy = gui.add_dropdown(
            "policy", tuple(session.policies), initial_value=session.policy_name
        )
        policy.on_update(lambda _: self._enqueue("policy", lambda: session.choose(policy.value)))
        speed = gui.add_slider("speed", 0.05, 4.0, 0.05, 1.0)
        speed.on_update(lambda _: setattr(self, "_speed", speed.value))
        auto_reset = gui.add_checkbox(
            "reset at the end", True, hint="also at the time limit; otherwise the episode continues"
        )
        auto_reset.on_update(lambda _: setattr(session, "auto_reset", auto_reset.value))
        self._add_push_controls()
        self._add_signal_plots()
        for (
            pattern,
            actuator,
        ) in session.config.actuators_by_name.items():
            suffix = f" {pattern}" if len(session.config.actuators_by_name) > 1 else ""
            family = actuator.family or type(actuator).__name__
            change = functools.partial(session.set_actuator, pattern)
            found_controls = controls(actuator, _MAX_SUPPLY)
            for part, fields in itertools.groupby(
                found_controls,
                lambda control: control.path[0] if len(control.path) > 1 else family,  # noqa: B023
            ):
                self._add_settings(f"{part}{suffix}", fields, change)
            if not found_controls:
                gui.add_markdown(
                    f"{family}{suffix} has no settings: start the view with `--actuator`."
                )
        disturbances = session.config.disturbances
        ends = {"command_delay": _DELAY_STEPS * session.recorder.step_duration}
        self._add_settings(
            "delay and disturbances", controls(disturbances, ends=ends), session.set_disturbance
        )

    def _add_push_controls(self) -> None:
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

            buttons.on_click(lambda _: self._enqueue(object(), push))

    def _add_signal_plots(self) -> None:
        gui, session = self.server.gui, self.session
        self._plots: list[tuple[list[int], viser.GuiUplotHandle]] = []
        self._motor: viser.GuiDropdownHandle | None = None
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
            session.recorder.trace_names, key=lambda name: not name.startswith(_FIRST_SIGNALS)
        ):
            if name in units:
                groups.setdefault(units[name], []).append(name)
        with gui.add_folder("signals"):
            if len(session.recorder.motor_names) > 1:
                self._motor = gui.add_dropdown("motor", tuple(session.recorder.motor_names))
            for title, names in groups.items():
                series = [
                    uplot.Series(label=name.replace("_", " "), stroke=colour, width=2)
                    for name, colour in zip(names, itertools.cycle(_COLORS), strict=False)
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

    def _add_settings(self, title: str, fields: Iterable[Control], change: ChangeSetting) -> None:
        """Add a folder with sliders and, inside it, a folder with the numbers that are typed."""
        gui, fields = self.server.gui, list(fields)
        with_slider = [
            control
            for control in fields
            if control.high is not None or control.options or isinstance(control.value, bool)
        ]
        typed = [control for control in fields if control not in with_slider]
        with gui.add_folder(title, expand_by_default=False):
            for control in with_slider:
                self._add_field(control, change)
            if typed:
                with gui.add_folder("more", expand_by_default=False):
                    for control in typed:
                        self._add_field(control, change)

    def _add_field(self, control: Control, change: ChangeSetting) -> None:
        gui, hint = self.server.gui, control.about
        label = control.path[-1].replace("_", " ") + (f" [{control.unit}]" if control.unit else "")
        handle: viser.GuiInputHandle
        if control.options:
            handle = gui.add_dropdown(
                label, control.options, initial_value=control.value, hint=hint
            )
        elif isinstance(control.value, bool):
            handle = gui.add_checkbox(label, control.value, hint=hint)
        elif control.high is None or control.low is None:
            handle = gui.add_number(label, control.value, min=control.low, hint=hint)
        elif isinstance(control.value, int):
            handle = gui.add_slider(
                label, int(control.low), int(control.high), 1, control.value, hint=hint
            )
        else:
            low, high = _round(control.low), _round(control.high)
            end = "; its end means unlimited" if control.is_unlimited else ""
            value = high if control.is_unlimited else min(max(float(control.value), low), high)
            handle = gui.add_slider(
                label, low, high, _round((high - low) / 200), value, hint=(hint or "") + end or None
            )
        handle.on_update(
            lambda _: self._enqueue(
                control.path, lambda: change(control.path, control.from_slider(handle.value))
            )
        )

    # -- requests of the clients ------------------------------------------------------------------

    def _enqueue(self, key: Hashable, action: Callable[[], None]) -> None:
        """Schedule an action between two frames, because viser calls back from its own threads."""
        self._pending.put((key, action))

    def _toggle(self) -> None:
        self.playing = not self.playing

    def _single_step(self) -> None:
        if self.playing:
            self._toggle()
        self.session.step()


def _triangles(shape: Shape, extent: float) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and triangles of a shape that is not a mesh of the model."""
    size = shape.size
    if shape.kind == "plane":
        x, y = (half if half > 0 else 20 * extent for half in size[:2])
        return np.array([[-x, -y, 0], [x, -y, 0], [x, y, 0], [-x, y, 0]]), np.array(
            [[0, 1, 2], [0, 2, 3]]
        )
    if shape.kind == "box":
        mesh = trimesh.creation.box(2 * np.array(size))
    elif shape.kind == "ellipsoid":
        mesh = trimesh.creation.icosphere(subdivisions=3).apply_scale(size)
    elif shape.kind == "capsule":
        mesh = trimesh.creation.capsule(height=2 * size[1], radius=size[0])
    else:
        mesh = trimesh.creation.cylinder(radius=size[0], height=2 * size[1], sections=48)
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def limit_for_uplot(values: np.ndarray) -> np.ndarray:
    """Return values that uPlot can draw: finite, and equal or at least 1e-6 of the largest apart.

    If all values differ only by rounding errors, uPlot's search for ticks runs until the memory is
    exhausted.
    """
    values = np.nan_to_num(values, posinf=_MAX_VALUE, neginf=-_MAX_VALUE).clip(
        -_MAX_VALUE, _MAX_VALUE
    )
    step = 1e-6 * np.abs(values).max(initial=0.0)
    return np.round(values / step) * step if step > np.finfo(float).tiny else np.zeros_like(values)


def _round(value: float) -> float:
    """Return a value with three digits, because a slider shows as many digits as its ends have."""
    return float(f"{value:.3g}")


def _escape_markdown(text: str) -> str:
    """Return text with escaped Markdown signs."""
    return "".join(f"\\{sign}" if sign in "\\`*_{}[]<>()#+-!|~" else sign for sign in text)
