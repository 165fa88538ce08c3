"""The swing-up in MJX: pure functions of one world, and many worlds for Stable-Baselines3."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from gymnasium import spaces
from mujoco import mjx
from stable_baselines3.common.vec_env import VecEnv
from swing_up import (
    FRAME_SKIP,
    MODEL,
    OBSERVATION_SPACE,
    TIME_LIMIT,
    initial_state,
    observation,
    reward,
)

from codrl_mj.arrays import prepare_model
from codrl_mj.arrays.mjx import MJXMotors, MotorState


class World(NamedTuple):
    """State of a world."""

    data: Any
    """Data of MJX."""
    motors: MotorState
    """State of the motors."""


class Outcome(NamedTuple):
    """World after an environment step."""

    world: World
    """Its state."""
    observation: jax.Array
    """Its observation, shape (3,)."""
    reward: jax.Array
    """Reward of the step."""


class SwingUpInMJX:
    """The task as pure functions of one world, for `jax.jit` and `jax.vmap`."""

    def __init__(self, actuators: Mapping[str, Any]) -> None:
        """Put the motor into the model."""
        self.motors = MJXMotors(prepare_model(MODEL, actuators))
        self.model = mjx.put_model(self.motors.model)

    def start(self, position: jax.Array, speed: jax.Array) -> World:
        """Return a world whose rod has an angle [rad] and a speed [rad/s]; its motor is at rest."""
        data = mjx.make_data(self.model).replace(qpos=position[None], qvel=speed[None])
        return World(data, self.motors.init())

    def step(self, world: World, action: jax.Array) -> Outcome:
        """Hold a torque, shape (1,), for an environment step."""

        def physics_step(world: World, _: None) -> tuple[World, None]:
            # This line is the only difference from a task without motors.
            after = self.motors.step(self.model, world.data, world.motors, action)
            return World(after.data, after.state), None

        world, _ = jax.lax.scan(physics_step, world, None, length=FRAME_SKIP)
        position, speed = world.data.qpos[0], world.data.qvel[0]
        return Outcome(
            world, observation(position, speed, jnp), reward(position, speed, action[0], jnp)
        )


class Worlds(VecEnv):
    """Worlds that step together. All episodes last `TIME_LIMIT` steps, so they end together."""

    def __init__(self, actuators: Mapping[str, Any], num_worlds: int) -> None:
        """Create the functions, which JAX compiles when they are called first."""
        task = SwingUpInMJX(actuators)
        self._start, self._step = jax.jit(jax.vmap(task.start)), jax.jit(jax.vmap(task.step))
        low, high = mujoco.MjModel.from_xml_path(str(MODEL)).actuator_ctrlrange.T.astype(np.float32)
        super().__init__(num_worlds, OBSERVATION_SPACE, spaces.Box(low, high))
        self.mean_returns: list[float] = []
        """Mean return of the worlds in each episode so far."""

    def restart(self, position: np.ndarray, speed: np.ndarray) -> np.ndarray:
        """Begin an episode from states, shapes (worlds,), and return the observations."""
        self._world = self._start(position.astype(np.float32), speed.astype(np.float32))
        self._returns, self._num_steps = np.zeros(self.num_envs), 0
        return observation(position, speed).astype(np.float32)

    def seed(self, seed: int | None = None) -> list[int | None]:
        """Seed the initial states; Stable-Baselines3 calls this."""
        self._generator, self.mean_returns = np.random.default_rng(seed), []
        return [seed] * self.num_envs

    def reset(self) -> np.ndarray:
        """Begin an episode from random states, and return the observations."""
        return self.restart(*initial_state(self._generator, self.num_envs))

    def step_async(self, actions: np.ndarray) -> None:
        """Keep the actions, shape (worlds, 1)."""
        self._actions = np.asarray(actions, np.float32)

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Step all worlds; at the time limit, all begin a new episode."""
        self._world, *results = self._step(self._world, self._actions)
        observations, rewards = map(np.array, results)
        self._returns, self._num_steps = self._returns + rewards, self._num_steps + 1
        is_over = self._num_steps == TIME_LIMIT
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        if is_over:
            self.mean_returns.append(float(self._returns.mean()))
            infos = [
                {"TimeLimit.truncated": True, "terminal_observation": last} for last in observations
            ]
            observations = self.reset()
        return observations, rewards, np.full(self.num_envs, is_over), infos

    @property
    def positions(self) -> np.ndarray:
        """Angles of the rods [rad], shape (worlds,)."""
        return np.array(self._world.data.qpos[:, 0])

    # The rest of the interface. Stable-Baselines3 asks for the attribute `render_mode`.
    def close(self) -> None:  # noqa: D102
        pass

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:  # noqa: ARG002, D102
        return [getattr(self, attr_name, None)] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:  # noqa: D102
        raise NotImplementedError

    def env_method(self, method_name: str, *args: Any, **settings: Any) -> list[Any]:  # noqa: D102
        raise NotImplementedError

    def env_is_wrapped(self, *_: Any) -> list[bool]:  # noqa: D102
        return [False] * self.num_envs
