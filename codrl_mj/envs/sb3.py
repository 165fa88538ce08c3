"""Vector environments with the interface of Stable-Baselines3."""

import time
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices

from codrl_mj.boundary import Argument, AttributeValue, Info
from codrl_mj.envs.config import Env, EnvConfig
from codrl_mj.envs.config import VecEnv as GymnasiumVecEnv
from codrl_mj.envs.serial import SerialVectorEnv
from codrl_mj.envs.snapshots import check_snapshot
from codrl_mj.envs.vector import ActuatedVectorEnv
from codrl_mj.physics import Signals


class ActuatedVecEnv(VecEnv):
    """N environments as one Stable-Baselines3 `VecEnv`, stepped as a batch for tasks on MuJoCo.

    An environment's info is empty until its episode ends; then it has `terminal_observation`,
    `TimeLimit.truncated` and `episode` (return, length and time, as Stable-Baselines3's `Monitor`
    records them). The actuators' signals of the last step are in `signals`, as arrays.
    """

    def __init__(self, env: GymnasiumVecEnv) -> None:
        """Wrap a vector environment in `SAME_STEP` mode.

        Raises:
            ValueError: it is of another class than those of `codrl_mj.make_vec`; or the agents
                cannot use its spaces or autoreset mode. It is closed first.
        """
        observation_space = env.single_observation_space
        action_space = env.single_action_space
        problem = ""
        if not isinstance(observation_space, spaces.Box) or len(observation_space.shape) != 1:
            problem = (
                f"observations are {observation_space}: must be a vector, because the"
                " agents' networks need one: flatten them with Gymnasium's FlattenObservation, and"
                " register that environment"
            )
        elif (
            not isinstance(action_space, spaces.Box | spaces.Discrete)
            or getattr(action_space, "start", 0) != 0
        ):
            problem = (
                f"actions are {action_space}: must be a vector (Box), or a choice (Discrete) that"
                " counts from 0"
            )
        elif not isinstance(env, ActuatedVectorEnv | SerialVectorEnv):
            problem = f"env = {env!r}: must be a vector environment of codrl_mj.make_vec"
        elif env.autoreset_mode != AutoresetMode.SAME_STEP:
            problem = (
                f"autoreset_mode = {env.autoreset_mode.value!r}: must be 'SameStep', the mode of"
                " Stable-Baselines3"
            )
        if problem or not isinstance(env, ActuatedVectorEnv | SerialVectorEnv):
            env.close()
            raise ValueError(problem)
        self.env = env
        self.arm_radii: np.ndarray = env.arm_radii
        """Arms of the motors [m]; 1 for a joint that is driven directly; shape (motors,)."""
        self._actions: np.ndarray | None = None
        self._returns = np.zeros(env.num_envs)
        self._lengths = np.zeros(env.num_envs, dtype=np.int64)
        self._start = time.time()
        super().__init__(env.num_envs, observation_space, action_space)

    def reset(self) -> np.ndarray:
        """Start an episode in every environment, with the seeds and options that were set."""
        options = self._options[0]
        if any(environment_options != options for environment_options in self._options):
            raise ValueError(
                f"set_options: {self._options}: the environments share them: give one mapping"
            )
        observations, _ = self.env.reset(seed=self._seeds, options=options or None)
        drawn_values = self.env.randomization
        self.reset_infos: list[Info] = [
            (
                {"randomization": {name: values[row] for name, values in drawn_values.items()}}
                if drawn_values
                else {}
            )
            for row in range(self.num_envs)
        ]
        self._reset_seeds()
        self._reset_options()
        self._returns[:], self._lengths[:] = 0.0, 0
        return observations

    @property
    def signals(self) -> Signals | None:
        """Actuators' signals of the last step, shape (N,) or (N, motors); None before the first."""
        return self.env.signals

    @property
    def randomization(self) -> dict[str, np.ndarray]:
        """Drawn values of the present episodes, arrays (N,); empty if nothing is randomized."""
        return self.env.randomization

    def step_async(self, actions: np.ndarray) -> None:
        """Store the actions of the next step."""
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[Info]]:
        """Step every environment; an environment whose episode ends is reset at once."""
        assert self._actions is not None, "step_async comes first"
        observations, rewards, terminated, truncated, infos = self.env.step(self._actions)
        self._returns += rewards
        self._lengths += 1
        ended = terminated | truncated
        outcomes: list[Info] = [{} for _ in range(self.num_envs)]
        for row in np.flatnonzero(ended).tolist():
            outcomes[row] = self._outcome(
                row, infos["final_obs"][row], bool(truncated[row] and not terminated[row])
            )
        self._returns[ended], self._lengths[ended] = 0.0, 0
        return observations, rewards.astype(np.float32), ended, outcomes

    def _outcome(self, row: int, observation: np.ndarray, truncated: bool) -> Info:
        """Return the info of an environment whose episode ended."""
        return {
            "terminal_observation": observation,
            "TimeLimit.truncated": truncated,
            "episode": {
                "r": round(float(self._returns[row]), 6),
                "l": int(self._lengths[row]),
                "t": round(time.time() - self._start, 6),
            },
        }

    def finish_episode(
        self, observation: np.ndarray, total: float, length: int, truncated: bool, signals: Signals
    ) -> tuple[np.ndarray, list[Info]]:
        """Record an episode that compiled code ran in a single environment, and reset it.

        Args:
            observation: its last observation, shape (k,).
            total: sum of its rewards.
            length: number of its steps.
            truncated: True if the time limit ended it, and not the task.
            signals: signals of its steps, arrays (length,).

        Returns:
            Observations and infos, as the last step would have returned them.
        """
        if self.num_envs != 1:
            raise ValueError(
                f"num_envs = {self.num_envs}: must be 1 if compiled code runs whole episodes"
            )
        self._returns[0], self._lengths[0] = total, length
        outcome = self._outcome(0, observation, truncated)
        observations, _ = self.env.reset()
        self.env.signals = {name: values[-1:] for name, values in signals.items()}
        self._returns[:], self._lengths[:] = 0.0, 0
        return observations, [outcome]

    def snapshot(self) -> dict[str, np.ndarray]:
        """Return the complete state as arrays: environments, episodes' records, pending seeds.

        The wall-clock time in `episode` is not part of it.
        """
        return self.env.snapshot() | self._records()

    def restore(self, snapshot: Mapping[str, np.ndarray]) -> np.ndarray | None:
        """Continue from a snapshot, bit for bit, in environments made with the same arguments.

        Returns:
            None; or the first observations (N, k), if the environments could only start a new
            episode.
        """
        records = self._records()
        check_snapshot(snapshot, self.env.snapshot() | records)
        first_observations = self.env.restore(
            {name: values for name, values in snapshot.items() if name not in records}
        )
        self._returns[:], self._lengths[:] = snapshot["returns"], snapshot["lengths"]
        self._seeds = [None if seed < 0 else seed for seed in snapshot["seeds"].tolist()]
        self._actions = None
        if first_observations is not None:
            self._returns[:], self._lengths[:] = 0.0, 0
        return first_observations

    def _records(self) -> dict[str, np.ndarray]:
        """Return the entries of a snapshot that this class adds to the environments'."""
        # An array of integers cannot hold None: -1 marks a seed that was not set.
        seeds = np.array([-1 if seed is None else seed for seed in self._seeds], dtype=np.int64)
        return {"returns": self._returns.copy(), "lengths": self._lengths.copy(), "seeds": seeds}

    def close(self) -> None:
        """Close the environments."""
        self.env.close()

    def get_images(self) -> Sequence[np.ndarray | None]:
        """Return an image of the first environment, and None for the others."""
        return [self.env.image(), *[None] * (self.num_envs - 1)]

    def render(self, mode: str | None = None) -> np.ndarray | None:
        """Return an image of the first environment."""
        del mode
        return self.env.image()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[AttributeValue]:
        """Return an attribute for each environment; all share an attribute of the vector."""
        shared = isinstance(self.env, SerialVectorEnv) and hasattr(self.env, attr_name)
        values = (
            [getattr(self.env, attr_name)] * self.num_envs
            if shared
            else self.env.get_attr(attr_name)
        )
        return [values[index] for index in self._get_indices(indices)]

    def set_attr(
        self, attr_name: str, value: AttributeValue, indices: VecEnvIndices = None
    ) -> None:
        """Set an attribute of the vector environment, or of each single environment."""
        if len(list(self._get_indices(indices))) != self.num_envs:
            raise ValueError(
                f"set_attr({attr_name!r}): the environments share it; it can only be set for all of"
                " them"
            )
        owners: list[object] = [self.env]
        if isinstance(self.env, SerialVectorEnv) and not hasattr(self.env, attr_name):
            owners = [env.unwrapped for env in self.env.envs]
        for owner in owners:
            setattr(owner, attr_name, value)

    def env_method(
        self,
        method_name: str,
        *method_args: Argument,
        indices: VecEnvIndices = None,
        **method_kwargs: Argument,
    ) -> list[AttributeValue]:
        """Call a method of the vector environment once; repeat its result for each environment."""
        result = getattr(self.env, method_name)(*method_args, **method_kwargs)
        return [result for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: type, indices: VecEnvIndices = None) -> list[bool]:
        """Return True for `Monitor`, which this class replaces; there are no other wrappers."""
        from stable_baselines3.common.monitor import Monitor

        return [issubclass(wrapper_class, Monitor) for _ in self._get_indices(indices)]


def make_sb3_vec_env(
    env_id: str | EnvConfig | Callable[..., Env],
    num_envs: int = 64,
    actuator: object = None,
    **arguments: Argument,
) -> ActuatedVecEnv:
    """Create a Stable-Baselines3 `VecEnv` of many environments.

    Args:
        env_id: a Gymnasium id, such as `codrl_mj/Pendulum-v0`, or another value of
            `EnvConfig.task`; an `EnvConfig`; or a function that makes an environment with motors,
            such as `functools.partial(codrl_mj.make, "Hopper-v5", {".*": "lag"})`.
        num_envs: number of environments, >= 1.
        actuator: as for `codrl_mj.make_vec`. Not allowed with a function, whose environments have
            their motors already.
        **arguments: as for `codrl_mj.envs.ActuatedVectorEnv`; the default time limit is
            Gymnasium's. Tasks on `mujoco` are stepped as a batch, all others one by one in a
            `SerialVectorEnv`.

    Raises:
        ValueError: unknown id, or an argument out of bounds; too little memory; or observations or
            actions that agents cannot use.
    """
    if callable(env_id):
        if actuator is not None:
            raise ValueError(
                f"actuator = {actuator!r}: the function makes environments that have their motors:"
                " leave it out, and pass functools.partial(codrl_mj.make, ENV, ACTUATOR)"
            )
        return ActuatedVecEnv(SerialVectorEnv(num_envs, env_id, **arguments))
    actuator_argument = {} if actuator is None else {"actuator": actuator}
    config, _ = EnvConfig.of(env_id)
    return ActuatedVecEnv(config.build_vec(num_envs, **actuator_argument, **arguments))
