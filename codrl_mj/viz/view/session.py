"""Running simulation: steps, pushes, policies, and settings of actuators and disturbances.

The module contains no server; `run_native` shows a session in MuJoCo's own viewer, which needs a
display.
"""

import dataclasses
import math
import time
from collections import deque
from collections.abc import Callable, Mapping
from types import MappingProxyType

import mujoco
import numpy as np
from gymnasium import spaces

from codrl_mj.actuators import override_actuator
from codrl_mj.actuators.parameters import FieldValue
from codrl_mj.boundary import Action
from codrl_mj.envs.config import Env, EnvConfig
from codrl_mj.evaluation import RandomPolicy, check_policy
from codrl_mj.evaluation.episodes import Recorder
from codrl_mj.fields import Checked, field_docs, nested_types
from codrl_mj.runs.policies import Policy

_NO_LIMIT = 10**9  # environment steps
_DIVERGENCE_WARNINGS = (
    mujoco.mjtWarning.mjWARN_BADQPOS,
    mujoco.mjtWarning.mjWARN_BADQVEL,
    mujoco.mjtWarning.mjWARN_BADQACC,
)
HISTORY = 10.0
"""Duration of the stored signals [s]."""
PUSH_DURATION = 0.1
"""Duration of a push [s]."""


@dataclasses.dataclass(frozen=True)
class Control:
    """A field that the user can set."""

    path: tuple[str, ...]
    """Names from the outermost part to the field."""
    unit: str
    """Unit; empty if there is none."""
    value: FieldValue
    """Current value; None if the field is not set."""
    low: float | None = None
    """Start of a number's slider: the bound, or a little above an excluded bound."""
    high: float | None = None
    """End of a number's slider; None if no scale is known, so that the number is typed."""
    options: tuple[str, ...] = ()
    """Choices of a text field."""
    about: str | None = None
    """Documentation of the field."""

    @property
    def is_unlimited(self) -> bool:
        """True if the end of the slider stands for infinity."""
        return bool(self.value == math.inf)

    def from_slider(self, slider_value: FieldValue) -> FieldValue:
        """Return the field's value for a value of the slider."""
        if self.is_unlimited and self.high is not None and slider_value >= self.high:
            return math.inf
        return slider_value


def controls(
    settings: Checked,
    scale: float | None = None,
    ends: Mapping[str, float] = MappingProxyType({}),
    path: tuple[str, ...] = (),
) -> list[Control]:
    """Return the controls for all numbers, texts and flags of an actuator or of disturbances.

    Args:
        settings: the dataclass.
        scale: end of the slider of an infinite voltage [V]; without it infinite fields are
            omitted.
        ends: field name -> end of its slider, for fields that are 0.
        path: names of the parts that lead to `settings`.
    """
    kind: type = type(settings)
    result: list[Control] = []
    nested, docs = nested_types(kind), field_docs(kind)
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        field_path = (*path, field.name)
        documentation = docs.get(field.name)
        if field.name in nested:
            result += controls(
                field.metadata.get("absent", value) if value is None else value,
                scale,
                ends,
                field_path,
            )
        elif "options" in field.metadata:
            result.append(
                Control(
                    field_path, "", value, options=field.metadata["options"], about=documentation
                )
            )
        elif isinstance(value, bool):
            result.append(Control(field_path, "", value, about=documentation))
        elif isinstance(value, int | float):
            unit = field.metadata.get("unit", "")
            low, high = field.metadata.get("between", (None, None))
            low, high = _slider_range(value, low, high, scale if unit == "V" else None)
            control = Control(
                field_path,
                unit,
                value,
                low,
                ends.get(field.name, high) if value == 0 else high,
                about=documentation,
            )
            result += [] if control.is_unlimited and control.high is None else [control]
    return result


def _slider_range(
    value: float, low: float | None, high: float | None, scale: float | None
) -> tuple[float | None, float | None]:
    """Return the range of a slider: a twentieth to four times the value, within the bounds.

    A value of 0 has only its bounds.
    """
    if math.isinf(value):
        return (scale / 100, scale) if scale else (None, None)
    if value == 0:
        return low, high
    near, far = sorted((0.05 * value, 4 * value))
    return (near if low is None else max(low, near)), (far if high is None else min(high, far))


class Session:
    """An environment, the policy that acts in it, and its recent signals.

    Invalid or unstable settings are not simulated: `problem` has the reason, and steps do nothing
    until the settings are changed. After a simulation has diverged, steps do
    nothing until a reset.
    """

    def __init__(
        self, config: EnvConfig, policies: Mapping[str, Callable[[], Policy]], seed: int = 0
    ) -> None:
        """Build the environment and start an episode.

        Args:
            config: `EnvConfig` of the environment.
            policies: name -> factory, called when the policy is chosen. `random` is added, and
                `zero` if an action does nothing. The first policy acts.
            seed: seed of the first episode, and of random actions.

        Raises:
            ValueError: the environment cannot be built, or has no MuJoCo model.
        """
        self.config = dataclasses.replace(config, max_episode_steps=_NO_LIMIT)
        self._limit = config.time_limit or _NO_LIMIT
        self.problem: str | None = None
        self.auto_reset = True
        """True to reset after an episode has ended or reached its time limit, False to go on."""
        self.signals: deque[tuple[float, np.ndarray]] = deque()
        """Time [s], and for each motor a row with the recorder's `trace_names`."""
        self._seed, self._diverged = seed, False
        self._pushes: dict[int, tuple[float, np.ndarray]] = {}
        self.env = self._make_env()
        self.policies: dict[str, Callable[[], Policy]] = {
            **policies,
            "random": lambda: RandomPolicy(self.env.action_space, self._seed),
        }
        if (action := self._zero_action()) is not None:
            zero_policy = _ConstantPolicy(action)
            self.policies["zero"] = lambda: zero_policy
        self.choose(next(iter(self.policies)))
        self.reset()

    # -- state ------------------------------------------------------------------------------------

    @property
    def model(self) -> mujoco.MjModel:
        """Model of the environment."""
        return self.env.unwrapped.model  # type: ignore[attr-defined]

    @property
    def data(self) -> mujoco.MjData:
        """Simulation data, with the current poses."""
        return self.env.unwrapped.data  # type: ignore[attr-defined]

    @property
    def bodies(self) -> list[str]:
        """Names of the bodies that can be pushed, the last of a chain first."""
        model = self.model
        movable = [
            body
            for body in range(1, model.nbody)
            if model.body_weldid[body] and model.body_subtreemass[body] > 0
        ]
        return [model.body(body).name for body in reversed(movable) if model.body(body).name]

    @property
    def is_stopped(self) -> bool:
        """True if the simulation cannot continue until a change or a reset."""
        return self.problem is not None

    # -- actions ----------------------------------------------------------------------------------

    def reset(self) -> None:
        """Start another episode."""
        if self._diverged:
            # Settings that cannot be built stay a problem after a reset; a divergence does not.
            self._diverged, self.problem = False, None
        self.observation, _ = self.env.reset(seed=self._seed)
        self._seed += 1
        self.time = self.total = 0.0
        self._steps, self.ended = 0, ""
        self.signals.clear()
        self._pushes.clear()
        self.data.xfrc_applied[:] = 0.0
        self._update_poses()

    def choose(self, name: str) -> None:
        """Let another policy act.

        Raises:
            FileNotFoundError: the run has no policy.
            ValueError: the policy's observations or actions are not those of this environment.
        """
        policy = self.policies[name]()
        try:
            check_policy(policy, self.env)
            space = self.env.observation_space
            # Policies observe arrays, so the space has a shape.
            zeros = np.zeros((1, *space.shape), space.dtype)  # type: ignore[misc]
            action, _ = policy.predict(zeros, deterministic=True)
            fits = self.env.action_space.contains(
                np.asarray(action[0], self.env.action_space.dtype)
            )
        except (ValueError, RuntimeError) as error:
            raise ValueError(f"policy {name}: does not fit this environment: {error}") from None
        if not fits:
            raise ValueError(
                f"policy {name}: its actions, such as {action[0]}, are not in"
                f" {self.env.action_space}"
            )
        self.policy, self.policy_name = policy, name

    def push(self, body: str, force: float, axis: int = 0) -> None:
        """Push a body at its center of mass for `PUSH_DURATION`.

        Args:
            body: name of the body.
            force: force [N].
            axis: axis of the world frame, 0 to 2.
        """
        vector = np.zeros(3)
        vector[axis] = force
        self._pushes[self.model.body(body).id] = (self.time + PUSH_DURATION, vector)

    def set_actuator(self, pattern: str, path: tuple[str, ...], value: FieldValue) -> None:
        """Set a field of the actuator of a motor, or of all motors that match a pattern.

        The motion continues, and the motor's state is reset.
        """
        for name in reversed(path):
            # `override_actuator` takes nested mappings: nest the path, from the inside out.
            value = {name: value}
        self._rebuild(
            lambda: {
                "actuator": {
                    **self.config.actuators_by_name,
                    pattern: override_actuator(self.config.actuators_by_name[pattern], value),
                }
            }
        )

    def set_disturbance(self, path: tuple[str, ...], value: FieldValue) -> None:
        """Set a field of the disturbances."""
        (name,) = path
        self._rebuild(
            lambda: {"disturbances": dataclasses.replace(self.config.disturbances, **{name: value})}
        )

    def step(self) -> bool:
        """Advance by one environment step, if possible.

        Returns:
            True if a step was simulated.
        """
        if self.is_stopped:
            return False
        if self.ended and self.auto_reset:
            self.reset()
        data = self.data
        for body, (end, force) in list(self._pushes.items()):
            data.xfrc_applied[body, :3] = force
            # Step times are sums with rounding errors, so that the comparison needs a tolerance.
            if self.time + 1e-9 >= end:
                del self._pushes[body]
                data.xfrc_applied[body] = 0.0
        action, _ = self.policy.predict(
            np.asarray(self.observation)[np.newaxis], deterministic=True
        )
        try:
            self.observation, reward, terminated, truncated, _ = self.env.step(action[0])
            # MuJoCo resets a diverged simulation to its initial state by itself, with a warning.
            was_reset = any(self.data.warning[kind].number for kind in _DIVERGENCE_WARNINGS)
            if was_reset or not np.isfinite(np.asarray(self.observation)).all():
                raise ArithmeticError("the simulation diverged to numbers that are not finite")
        except ArithmeticError as error:
            self.problem = f"{error}; reset it, and change the settings of the motor"
            self._diverged = True
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
        self._update_poses()
        return True

    # -- internal ---------------------------------------------------------------------------------

    def _make_env(self) -> Env:
        env = self.config.build()
        if getattr(env.unwrapped, "model", None) is None:
            raise ValueError(
                f"{self.config.task} has no MuJoCo model to show: physics must be mujoco, the"
                " default"
            )
        self.recorder: Recorder = env.get_wrapper_attr("recorder")
        return env

    def _rebuild(self, make_changes: Callable[[], dict[str, FieldValue]]) -> None:
        """Continue in an environment with other settings, or set `problem` if that fails."""
        positions, speeds = self.data.qpos.copy(), self.data.qvel.copy()
        # The old environment stays in use if the new one cannot be built.
        previous = self.env, self.recorder
        try:
            self.config = dataclasses.replace(self.config, **make_changes())
            self.env = self._make_env()
            self.env.reset(seed=self._seed)
        except ValueError as error:
            self.env, self.recorder = previous
            self.problem = str(error)
            return
        previous[0].close()
        self.problem = None
        if self._diverged:
            self.reset()
        else:
            self.data.qpos[:], self.data.qvel[:] = positions, speeds
            # Recompute everything that depends on the copied positions and speeds, such as
            # contacts.
            mujoco.mj_forward(self.model, self.data)

    def _update_poses(self) -> None:
        """Update the poses, which after a step are still those of its start."""
        physics = getattr(self.env.unwrapped, "physics", None)
        if physics is None:
            mujoco.mj_kinematics(self.model, self.data)
        else:
            physics.show(physics.state)

    def _zero_action(self) -> Action:
        """Return the action that causes no force; None if there is no such action."""
        space, setup = self.env.action_space, getattr(self.env.unwrapped, "setup", None)
        if isinstance(space, spaces.Box):
            return np.clip(np.zeros(space.shape, space.dtype), space.low, space.high)
        if isinstance(space, spaces.Discrete) and setup is not None:
            forces = {
                action: np.abs(setup.commands.force(action)).max() for action in range(int(space.n))
            }
            min_action = min(forces, key=lambda action: forces[action])
            # A discrete action does nothing if its force is zero, for example the middle one of
            # three.
            return min_action if math.isclose(forces[min_action], 0.0, abs_tol=1e-12) else None
        return None


class _ConstantPolicy:
    """Policy that always takes the same action."""

    def __init__(self, action: Action) -> None:
        """Store the action."""
        self._action = action

    def predict(
        self,
        observation: np.ndarray,
        *,
        deterministic: bool = False,  # noqa: ARG002 - required by the Policy protocol
    ) -> tuple[np.ndarray, None]:
        """Return the action for each observation."""
        return np.array([self._action] * len(observation)), None


def run_native(session: Session) -> None:
    """Simulate in real time until the window is closed; its mouse can push bodies."""
    from mujoco import viewer

    with viewer.launch_passive(session.model, session.data) as window:
        while window.is_running():
            step_start = time.perf_counter()
            with window.lock():
                session.step()
            window.sync()
            time.sleep(
                max(0.0, session.recorder.step_duration - (time.perf_counter() - step_start))
            )
