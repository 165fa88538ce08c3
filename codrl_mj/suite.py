"""Environments with the interface of dm_env: `suite.load("pendulum", "gym")`, or `DmEnvironment`.

`DmEnvironment` wraps any Gymnasium environment; dynamics, rewards and terminations are its own, bit
for bit. Needs the extra `dm-control`, which installs MuJoCo 3. With MuJoCo 4 everything works if
dm_env is installed, except `physics`: dm_control 1.0.50 needs MuJoCo 3.
"""

import copy
import operator
from collections.abc import Mapping
from typing import Any

import dm_env
import numpy as np
from dm_env import specs
from gymnasium import spaces

from codrl_mj.boundary import Action, Argument, AttributeValue, Info, Observation, PickledState
from codrl_mj.envs.config import Env, EnvConfig
from codrl_mj.envs.snapshots import check_snapshot, elapsed_steps, set_elapsed_steps
from codrl_mj.external_envs import check_dm_control
from codrl_mj.tasks import TASKS

TASK_NAME = "gym"


def __getattr__(name: str) -> object:
    """Return `ALL_TASKS`: (domain, task) of all tasks at present, including custom ones."""
    if name == "ALL_TASKS":
        return tuple((domain, TASK_NAME) for domain in TASKS)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


class DmEnvironment(dm_env.Environment):
    """A Gymnasium environment with dm_env's interface, and with all its own attributes.

    Examples are `state`, `model`, `data`, `render` and `randomization`. The last step's `info`,
    with the actuators' signals, is in `info`.
    """

    def __init__(self, env: Env, random: object = None, flat_observation: bool = False) -> None:
        """Wrap an environment.

        Args:
            env: the environment, with discrete actions or a box of them.
            random: a seed or a `numpy.random.Generator` for the initial states; None: any.
            flat_observation: True for a single vector, `observations`, even if the entries have
                names; third-party observations without names always are.
        """
        self.env, self.info = env, Info()
        self._ended, self._seed = True, None
        if isinstance(random, np.random.Generator):
            env.unwrapped.np_random = random
        elif random is not None:
            self._seed = operator.index(random)  # type: ignore[arg-type]  # it raises TypeError
        self._names = () if flat_observation else getattr(env.unwrapped, "observation_names", ())
        # A dm_control.mujoco.Physics; dm_control is imported on first use.
        self._physics: Any = None

    def reset(self) -> dm_env.TimeStep:
        """Start an episode."""
        observation, self.info = self.env.reset(seed=self._seed)
        self._seed, self._ended = None, False
        return dm_env.restart(self._entries(observation))

    def step(self, action: Action) -> dm_env.TimeStep:
        """Advance by one environment step; the step after the end of an episode resets.

        If the task terminates an episode, the last discount is 0; at the time limit it is 1. If
        both happen in the same step, it is 1, as everywhere in dm_control.

        Raises:
            ValueError: the action is not one of the action spec.
            SimulationDivergedError: a value of the simulation is not finite.
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

    def _entries(self, observation: Observation) -> dict[str, np.ndarray]:
        """Return the observation's entries by name, floating-point ones in float64."""
        entries = observation if isinstance(observation, dict) else {"observations": observation}
        if self._names:
            entries = {name: [value] for name, value in zip(self._names, observation, strict=True)}
        arrays = {name: np.array(values) for name, values in entries.items()}
        return {
            name: array.astype(np.float64) if array.dtype.kind == "f" else array
            for name, array in arrays.items()
        }

    def observation_spec(self) -> dict[str, specs.Array]:
        """Return the specification of the observation space, by name."""
        # Sampling changes a space's generator, which is the user's: a copy is sampled.
        entries = self._entries(copy.deepcopy(self.env.observation_space).sample())
        return {
            name: specs.Array(array.shape, array.dtype, name) for name, array in entries.items()
        }

    def action_spec(self) -> specs.Array:
        """Return the specification of the action space."""
        space = self.env.action_space
        if isinstance(space, spaces.Discrete):
            return specs.DiscreteArray(int(space.n), name="action")
        assert isinstance(space, spaces.Box)
        return specs.BoundedArray(space.shape, space.dtype, space.low, space.high, name="action")

    @property
    def physics(self) -> Any:  # mypy does not read dm_control
        """The present model and data as a `dm_control.mujoco.Physics`.

        It offers named indexing, `render` and `reset_context`. Steps must be the environment's own;
        use `snapshot` and `restore` for complete states.

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
        """Return the duration of a step [s]."""
        env = self.env.unwrapped
        return float(env.step_duration if hasattr(env, "step_duration") else self.dt)

    def snapshot(self) -> dict[str, np.ndarray]:
        """Return the complete state as arrays: the environment's, and its time limit's count."""
        env_state: dict[str, np.ndarray] = self.env.get_wrapper_attr("snapshot")()
        return env_state | {"elapsed": elapsed_steps(self.env), "ended": np.array(self._ended)}

    def restore(self, snapshot: Mapping[str, np.ndarray]) -> dict[str, np.ndarray] | None:
        """Continue from a snapshot, bit for bit, in an environment made with the same arguments.

        Returns:
            None; or the first observation, if the environment could only start a new episode.

        Raises:
            ValueError: the snapshot is of another environment or other arguments; nothing was
                changed.
        """
        check_snapshot(snapshot, self.snapshot())
        # Gymnasium's wrappers refuse to be used before a first reset.
        self.env.reset()
        env_state = {
            name: values for name, values in snapshot.items() if name not in ("elapsed", "ended")
        }
        first_observation = self.env.get_wrapper_attr("restore")(env_state)
        self._ended = first_observation is None and bool(snapshot["ended"])
        if first_observation is not None:
            return self._entries(first_observation)
        set_elapsed_steps(self.env, snapshot["elapsed"])
        return None

    def close(self) -> None:
        """Close the environment."""
        self.env.close()

    def __getattr__(self, name: str) -> AttributeValue:
        """Return another attribute of the environment."""
        if name.startswith("__") or name == "env":
            raise AttributeError(name)
        return self.env.get_wrapper_attr(name)

    def __getstate__(self) -> PickledState:
        """Return all but the view of the simulation; a copy makes a new one."""
        return self.__dict__ | {"_physics": None}


def load(
    domain_name: Argument,
    task_name: str = TASK_NAME,
    actuator: object = None,
    task_kwargs: Mapping[str, Argument] | None = None,
    environment_kwargs: Mapping[str, Argument] | None = None,
    **options: Argument,
) -> DmEnvironment:
    """Load a task as a dm_env environment.

    Args:
        domain_name: task name, such as `pendulum`; or an `EnvConfig`.
        task_name: `gym`.
        actuator: as for `codrl_mj.make`.
        task_kwargs: `random`, as for `DmEnvironment`.
        environment_kwargs: `flat_observation`, as for `DmEnvironment`.
        **options: the other fields of `codrl_mj.envs.config.EnvConfig`, and options of the task;
            they replace those of a configuration.
    """
    if task_name != TASK_NAME:
        raise ValueError(f"task_name = {task_name!r}: every domain has one task, {TASK_NAME!r}")
    task_arguments = task_kwargs or {}
    if task_arguments.keys() - {"random"}:
        raise ValueError(f"task_kwargs = {dict(task_arguments)!r}: may only hold 'random'")
    if not isinstance(domain_name, str | EnvConfig):
        raise ValueError(
            f"domain_name = {domain_name!r}: must be a task's name or an EnvConfig; wrap other"
            " environments in DmEnvironment(...)"
        )
    config, remaining = EnvConfig.of(domain_name, actuator, options)
    env = config.build(**remaining)
    return DmEnvironment(env, task_arguments.get("random"), **(environment_kwargs or {}))
