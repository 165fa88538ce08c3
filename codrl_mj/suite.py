"""Environments as dm_env agents know them: `suite.load("pendulum", "gym")`, or any of Gymnasium's in a `DmEnvironment`.

Dynamics, rewards and ends are the Gymnasium environment's, bit for bit. Needs the extra
`dm-control`, which brings MuJoCo 3. With MuJoCo 4 it works where dm_env is installed, but for
`physics`: dm_control 1.0.50 needs MuJoCo 3.
"""

import copy
import dataclasses
import operator
from collections.abc import Mapping
from typing import Any

import dm_env
import gymnasium
import numpy as np
from dm_env import specs
from gymnasium import spaces

from codrl_mj.envs.config import EnvConfig
from codrl_mj.envs.snapshots import check_snapshot, elapsed_steps, set_elapsed_steps
from codrl_mj.external_envs import check_dm_control
from codrl_mj.tasks import TASKS

TASK_NAME = "gym"
_DEFAULT = object()
"""The actuator where none is given: the task's, or a configuration's own."""


def __getattr__(name: str) -> Any:
    """`ALL_TASKS`: every (domain, task) that `load` knows by name at present, tasks of one's own included."""
    if name == "ALL_TASKS":
        return tuple((domain, TASK_NAME) for domain in TASKS)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


class DmEnvironment(dm_env.Environment):
    """A Gymnasium environment with dm_env's interface; whatever else that one has is had through this.

    Such as `state`, `model`, `data`, `render` and `randomization`. The `info` of the last step,
    with the actuators' signals, is in `info`.
    """

    def __init__(
        self, env: "gymnasium.Env[Any, Any]", random: Any = None, flat_observation: bool = False
    ) -> None:
        """Wrap an environment.

        Args:
            env: the environment, of discrete actions or a box of them.
            random: a seed or a `numpy.random.Generator` for the initial states; any if None.
            flat_observation: whether our tasks' observations are one vector, `observations`, as
                those of others are that have no names.
        """
        self.env, self.info = env, dict[str, Any]()
        self._ended, self._seed = True, None
        if isinstance(random, np.random.Generator):
            env.unwrapped.np_random = random
        elif random is not None:
            self._seed = operator.index(random)
        self._names = () if flat_observation else getattr(env.unwrapped, "observation_names", ())
        self._physics: Any = (
            None  # a dm_control.mujoco.Physics, which is imported when it is first asked for
        )

    def reset(self) -> dm_env.TimeStep:
        """Start an episode."""
        observation, self.info = self.env.reset(seed=self._seed)
        self._seed, self._ended = None, False
        return dm_env.restart(self._entries(observation))

    def step(self, action: Any) -> dm_env.TimeStep:
        """Advance by one environment step; an episode that has ended starts anew.

        An episode ends with discount 0 where the task says so and with discount 1 at the time
        limit; a last step that is both has discount 1, as everywhere in dm_control.

        Raises:
            ValueError: the action is not of the action spec.
            SimulationDivergedError: the simulation left the finite numbers.
        """
        if self._ended:
            return self.reset()
        if isinstance(self.env.action_space, spaces.Discrete):
            try:
                action = operator.index(action) + int(self.env.action_space.start)
            except TypeError:
                raise ValueError(f"action = {action!r}: not in {self.env.action_space}") from None
        observation, reward, terminated, truncated, self.info = self.env.step(action)
        self._ended = terminated or truncated
        kind = dm_env.StepType.LAST if self._ended else dm_env.StepType.MID
        discount = 0.0 if terminated and not truncated else 1.0
        return dm_env.TimeStep(kind, reward, discount, self._entries(observation))

    def _entries(self, observation: Any) -> dict[str, np.ndarray]:
        """The observation's entries by name, real ones in float64."""
        entries = observation if isinstance(observation, dict) else {"observations": observation}
        if self._names:
            entries = {name: [value] for name, value in zip(self._names, observation, strict=True)}
        arrays = {name: np.array(values) for name, values in entries.items()}
        return {
            name: one.astype(np.float64) if one.dtype.kind == "f" else one
            for name, one in arrays.items()
        }

    def observation_spec(self) -> dict[str, specs.Array]:
        """The observation space, by name."""
        some = self._entries(
            copy.deepcopy(self.env.observation_space).sample()
        )  # whose generator is the user's
        return {name: specs.Array(one.shape, one.dtype, name) for name, one in some.items()}

    def action_spec(self) -> specs.Array:
        """The action space."""
        space = self.env.action_space
        if isinstance(space, spaces.Discrete):
            return specs.DiscreteArray(int(space.n), name="action")
        assert isinstance(space, spaces.Box)
        return specs.BoundedArray(space.shape, space.dtype, space.low, space.high, name="action")

    @property
    def physics(self) -> Any:
        """dm_control's view of the simulation's present model and data: named indexing, `render`, `reset_context`.

        It is a `dm_control.mujoco.Physics`. Steps are the environment's own; so are complete saved
        states, `snapshot` and `restore`.

        Raises:
            RuntimeError: dm_control does not work with the installed MuJoCo.
        """
        check_dm_control()
        from dm_control import mujoco as dm_mujoco
        from dm_control.mujoco import wrapper

        data = self.data
        if self._physics is None or self._physics.data.ptr is not data:
            self._physics = dm_mujoco.Physics(wrapper.MjData(data))
        getattr(self.env.unwrapped, "pose", lambda: None)()
        return self._physics

    def control_timestep(self) -> float:
        """The duration of a step [s]."""
        own = self.env.unwrapped
        return float(own.step_duration if hasattr(own, "step_duration") else self.dt)

    def snapshot(self) -> dict[str, np.ndarray]:
        """Everything that the future depends on, as plain arrays: the environment's own, and its time limit's count."""
        own: dict[str, np.ndarray] = self.env.get_wrapper_attr("snapshot")()
        return own | {"elapsed": elapsed_steps(self.env), "ended": np.array(self._ended)}

    def restore(self, snapshot: Mapping[str, np.ndarray]) -> dict[str, np.ndarray] | None:
        """Continue from what `snapshot` returned, bit for bit, in an environment made with the same arguments.

        Returns:
            None; or the first observation of an episode, where the environment could only start one
            anew.

        Raises:
            ValueError: the snapshot is of another environment or other arguments; nothing was
                changed.
        """
        check_snapshot(snapshot, self.snapshot())
        self.env.reset()  # which Gymnasium's wrappers insist on
        own = {
            name: values for name, values in snapshot.items() if name not in ("elapsed", "ended")
        }
        begun = self.env.get_wrapper_attr("restore")(own)
        self._ended = begun is None and bool(snapshot["ended"])
        if begun is not None:
            return self._entries(begun)
        set_elapsed_steps(self.env, snapshot["elapsed"])
        return None

    def close(self) -> None:
        """Free what the environment holds."""
        self.env.close()

    def __getattr__(self, name: str) -> Any:
        """What else the environment has."""
        if name.startswith("__") or name == "env":
            raise AttributeError(name)
        return self.env.get_wrapper_attr(name)

    def __getstate__(self) -> dict[str, Any]:
        """Everything but the view of the simulation, which a copy has of its own."""
        return self.__dict__ | {"_physics": None}


def load(
    domain_name: Any,
    task_name: str = TASK_NAME,
    actuator: Any = _DEFAULT,
    task_kwargs: Mapping[str, Any] | None = None,
    environment_kwargs: Mapping[str, Any] | None = None,
    **options: Any,
) -> DmEnvironment:
    """A task as a dm_env environment.

    Args:
        domain_name: task name, such as `pendulum`; or an environment's whole configuration.
        task_name: `gym`.
        actuator: as for `codrl_mj.envs.ActuatedEnv`, the task's own unless given; over a
            configuration's.
        task_kwargs: `random`, as for `DmEnvironment`.
        environment_kwargs: `flat_observation`, as for `DmEnvironment`.
        **options: the other fields of `codrl_mj.envs.config.EnvConfig`, and the task's own options,
            over a configuration's.
    """
    if task_name != TASK_NAME:
        raise ValueError(f"task_name = {task_name!r}: every domain has one task, {TASK_NAME!r}")
    given = task_kwargs or {}
    if given.keys() - {"random"}:
        raise ValueError(f"task_kwargs = {dict(given)!r}: may only hold 'random'")
    if isinstance(domain_name, str):
        limit = options.pop("max_episode_steps", None)
        config: Any = EnvConfig.of(
            domain_name, "default" if actuator is _DEFAULT else actuator, options
        )
        config = dataclasses.replace(config, max_episode_steps=limit)
    elif not isinstance(domain_name, EnvConfig):
        raise ValueError(
            f"domain_name = {domain_name!r}: must be a task's name or an EnvConfig; others go into"
            " DmEnvironment(...)"
        )
    else:
        over = options if actuator is _DEFAULT else {"actuator": actuator, **options}
        config = EnvConfig.from_mapping(over, domain_name)
    return DmEnvironment(config.make(), given.get("random"), **(environment_kwargs or {}))
