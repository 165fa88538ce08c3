"""A simulation under way: steps, pushes, other policies, and what can be set of actuators and disturbances meanwhile.

There is no server in it; its one window is MuJoCo's own viewer, on a machine with a display.
"""

import dataclasses
import math
import time
from collections import deque
from collections.abc import Callable, Mapping
from types import MappingProxyType, SimpleNamespace
from typing import Any

import mujoco
import numpy as np
from gymnasium import spaces

from codrl_mj.actuators import override_actuator
from codrl_mj.evaluation import RandomPolicy
from codrl_mj.fields import field_docs, parts

_FOREVER = 10**9  # environment steps
_DIVERGED = (
    mujoco.mjtWarning.mjWARN_BADQPOS,
    mujoco.mjtWarning.mjWARN_BADQVEL,
    mujoco.mjtWarning.mjWARN_BADQACC,
)
HISTORY = 10.0
"""What of the signals is remembered [s]."""
PUSH_DURATION = 0.1
"""How long a push lasts [s]."""


@dataclasses.dataclass(frozen=True)
class Control:
    """A field that can be set."""

    path: tuple[str, ...]
    """Names from the outermost part to the field."""
    unit: str
    """Its unit; empty for none."""
    value: Any
    """What it is now; None where it is not set."""
    low: float | None = None
    """Of a number: where its slider begins; the bound, or a little above one that is excluded."""
    high: float | None = None
    """Of a number: where its slider ends; None where a scale for it is not known, so that it is typed."""
    options: tuple[str, ...] = ()
    """Of a word: what it may be."""
    about: str | None = None
    """What its documentation says."""

    @property
    def endless(self) -> bool:
        """Whether the end of the slider stands for infinity."""
        return self.value == math.inf

    def parsed(self, shown: Any) -> Any:
        """The field's value for what a slider shows."""
        if self.endless and self.high is not None and shown >= self.high:
            return math.inf
        return shown


def controls(
    settings: Any,
    scale: float | None = None,
    ends: Mapping[str, float] = MappingProxyType({}),
    path: tuple[str, ...] = (),
) -> list[Control]:
    """Numbers, words and flags in an actuator or disturbances, and in its parts, of which `path` leads to this one.

    The slider of an infinite voltage ends at `scale` [V], without which infinite fields are left
    out; that of a field that is 0 where `ends` says so by its name.
    """
    kind: Any = type(settings)
    found, nested, docs = [], parts(kind), field_docs(kind)
    for field in dataclasses.fields(settings):
        value, own, about = getattr(settings, field.name), (*path, field.name), docs.get(field.name)
        if field.name in nested:
            found += controls(
                field.metadata.get("absent") if value is None else value, scale, ends, own
            )
        elif "options" in field.metadata:
            found.append(Control(own, "", value, options=field.metadata["options"], about=about))
        elif isinstance(value, bool):
            found.append(Control(own, "", value, about=about))
        elif isinstance(value, int | float):
            unit = field.metadata.get("unit", "")
            low, high = field.metadata.get("between", (None, None))
            low, high = _slider(value, low, high, scale if unit == "V" else None)
            one = Control(
                own,
                unit,
                value,
                low,
                ends.get(field.name, high) if value == 0 else high,
                about=about,
            )
            found += [] if one.endless and one.high is None else [one]
    return found


def _slider(
    value: float, low: float | None, high: float | None, scale: float | None
) -> tuple[float | None, float | None]:
    """From a twentieth of the value to four times it, within the bounds; of what is 0 the bounds alone."""
    if math.isinf(value):
        return (scale / 100, scale) if scale else (None, None)
    if value == 0:
        return low, high
    near, far = sorted((0.05 * value, 4 * value))
    return (near if low is None else max(low, near)), (far if high is None else min(high, far))


class Session:
    """An environment, what acts in it, and what it did lately.

    Settings that cannot be simulated, unstable ones among them, are not: `problem` says why, and
    steps wait until they are set otherwise. So they do after a simulation left the finite numbers,
    until a reset.
    """

    def __init__(
        self, config: Any, policies: Mapping[str, Callable[[], Any]], seed: int = 0
    ) -> None:
        """Build the environment and start an episode.

        Args:
            config: its `EnvConfig`.
            policies: by name, made when they are chosen; `random`, and `zero` where an action does
                nothing, are there besides. The first one acts.
            seed: of the first episode, and of random actions.

        Raises:
            ValueError: it cannot be built, or has no MuJoCo model.
        """
        self.config = dataclasses.replace(config, max_episode_steps=_FOREVER)
        self._limit = config.time_limit or _FOREVER
        self.problem: str | None = None
        self.again = True
        """Whether an episode that ended, or reached the time limit, begins anew by itself; otherwise it goes on."""
        self.signals: deque[tuple[float, np.ndarray]] = deque()
        """Time [s], and a row of the recorder's `trace_names` for each motor."""
        self._seed, self._diverged, self._pushes = seed, False, {}  # type: ignore[var-annotated]
        self.env = self._made()
        self.policies = {
            **policies,
            "random": lambda: RandomPolicy(self.env.action_space, self._seed),
        }
        if (action := self._nothing()) is not None:
            still = SimpleNamespace(
                predict=lambda seen, **_: (np.array([action] * len(seen)), None)
            )
            self.policies["zero"] = lambda: still
        self.choose(next(iter(self.policies)))
        self.reset()

    # -- what is there ---------------------------------------------------------------------------------------

    @property
    def model(self) -> mujoco.MjModel:
        """The model."""
        return self.env.unwrapped.model

    @property
    def data(self) -> mujoco.MjData:
        """The simulation, with the poses of now."""
        return self.env.unwrapped.data

    @property
    def bodies(self) -> list[str]:
        """Names of the bodies that can be pushed, the last of a chain first."""
        model = self.model
        moves = [
            body
            for body in range(1, model.nbody)
            if model.body_weldid[body] and model.body_subtreemass[body] > 0
        ]
        return [model.body(body).name for body in reversed(moves) if model.body(body).name]

    @property
    def waits(self) -> bool:
        """Whether nothing can be simulated at present."""
        return self.problem is not None

    # -- what can be done ------------------------------------------------------------------------------------

    def reset(self) -> None:
        """Start another episode."""
        if self._diverged:
            self._diverged, self.problem = False, None
        self.observation, _ = self.env.reset(seed=self._seed)
        self._seed += 1
        self.time = self.total = 0.0
        self._steps, self.ended = 0, ""
        self.signals.clear()
        self._pushes.clear()
        self.data.xfrc_applied[:] = 0.0
        self._posed()

    def choose(self, name: str) -> None:
        """Let another policy act.

        Raises:
            FileNotFoundError: its run has none.
            ValueError: unknown, or it observes or commands something else than this environment
                has.
        """
        policy = self.policies[name]()
        try:
            space = self.env.observation_space
            action, _ = policy.predict(np.zeros((1, *space.shape), space.dtype), deterministic=True)
            fits = self.env.action_space.contains(
                np.asarray(action[0], self.env.action_space.dtype)
            )
        except (ValueError, RuntimeError) as error:
            raise ValueError(f"policy {name}: does not fit this environment: {error}") from None
        if not fits:
            raise ValueError(
                f"policy {name}: its actions, such as {action[0]}, are none of"
                f" {self.env.action_space}"
            )
        self.policy, self.chosen = policy, name

    def push(self, body: str, force: float, axis: int = 0) -> None:
        """Push a body at its centre of mass for `PUSH_DURATION`.

        Args:
            body: its name.
            force: [N].
            axis: of the world, 0 to 2.
        """
        vector = np.zeros(3)
        vector[axis] = force
        self._pushes[self.model.body(body).id] = (self.time + PUSH_DURATION, vector)

    def set_actuator(self, pattern: str, path: tuple[str, ...], value: Any) -> None:
        """Set a field of what drives a motor, or the motors of a pattern; the motion goes on, the motor is at rest."""
        for name in reversed(path):
            value = {name: value}
        self._rebuild(
            lambda: {
                "actuator": {
                    **self.config.driven,
                    pattern: override_actuator(self.config.driven[pattern], value),
                }
            }
        )

    def set_disturbance(self, path: tuple[str, ...], value: Any) -> None:
        """Set a field of the disturbances."""
        (name,) = path
        self._rebuild(
            lambda: {"disturbances": dataclasses.replace(self.config.disturbances, **{name: value})}
        )

    def step(self) -> bool:
        """Advance by one environment step, if it can be simulated.

        Returns:
            Whether it was.
        """
        if self.waits:
            return False
        if self.ended and self.again:
            self.reset()
        data = self.data
        for body, (end, force) in list(self._pushes.items()):
            data.xfrc_applied[body, :3] = force
            if self.time + 1e-9 >= end:
                del self._pushes[body]
                data.xfrc_applied[body] = 0.0
        action, _ = self.policy.predict(
            np.asarray(self.observation)[np.newaxis], deterministic=True
        )
        try:
            self.observation, reward, terminated, truncated, _ = self.env.step(action[0])
            # from numbers that are none it begins anew by itself
            began_anew = any(self.data.warning[kind].number for kind in _DIVERGED)
            if began_anew or not np.isfinite(np.asarray(self.observation)).all():
                raise ArithmeticError("the simulation left the finite numbers")
        except ArithmeticError as error:
            self.problem, self._diverged = f"{error}; reset, and set what drives it otherwise", True
            return False
        rows = self.recorder.trace
        for row in rows:
            self.time += self.recorder.step_duration / len(rows)
            self.signals.append((self.time, row.copy()))
        while self.signals and self.signals[0][0] < self.time - HISTORY:
            self.signals.popleft()
        self.total += float(reward)
        self._steps += 1
        self.ended = (
            "ended"
            if terminated or truncated
            else "past the time limit" * (self._steps >= self._limit)
        )
        self._posed()
        return True

    # -- within ----------------------------------------------------------------------------------------------

    def _made(self) -> Any:
        env: Any = self.config.make()
        if getattr(env.unwrapped, "model", None) is None:
            raise ValueError(
                f"{self.config.task} has no MuJoCo model to be shown; physics must be mujoco, its"
                " default"
            )
        self.recorder: Any = env.get_wrapper_attr("recorder")
        return env

    def _rebuild(self, changed: Callable[[], dict[str, Any]]) -> None:
        """Go on in an environment with other settings, or say why that cannot be."""
        positions, speeds = self.data.qpos.copy(), self.data.qvel.copy()
        old = self.env, self.recorder
        try:
            self.config = dataclasses.replace(self.config, **changed())
            self.env = self._made()
            self.env.reset(seed=self._seed)
        except ValueError as error:
            self.env, self.recorder = old
            self.problem = str(error)
            return
        old[0].close()
        self.problem = None
        if self._diverged:
            self.reset()
        else:
            self.data.qpos[:], self.data.qvel[:] = positions, speeds
            mujoco.mj_forward(self.model, self.data)

    def _posed(self) -> None:
        """Bring the poses up to date: a step leaves those of its beginning."""
        physics = getattr(self.env.unwrapped, "physics", None)
        if physics is None:
            mujoco.mj_kinematics(self.model, self.data)
        else:
            physics.show(physics.state)

    def _nothing(self) -> Any:
        """The action that does nothing; None if there is none."""
        space, setup = self.env.action_space, getattr(self.env.unwrapped, "setup", None)
        if isinstance(space, spaces.Box):
            return np.clip(np.zeros(space.shape, space.dtype), space.low, space.high)
        if isinstance(space, spaces.Discrete) and setup is not None:
            forces = {
                action: np.abs(setup.commands.force(action)).max() for action in range(int(space.n))
            }
            least = min(forces, key=lambda action: forces[action])
            return least if math.isclose(forces[least], 0.0, abs_tol=1e-12) else None
        return None


def run_native(session: Session) -> None:
    """Simulate in real time until the window is closed; there its mouse pushes bodies."""
    from mujoco import viewer

    with viewer.launch_passive(session.model, session.data) as window:
        while window.is_running():
            began = time.perf_counter()
            with window.lock():
                session.step()
            window.sync()
            time.sleep(max(0.0, session.recorder.step_duration - (time.perf_counter() - began)))
