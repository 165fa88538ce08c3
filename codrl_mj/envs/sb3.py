"""The vector environments as Stable-Baselines3 knows them."""

import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.vec_env import VecEnv

from codrl_mj.envs.config import EnvConfig
from codrl_mj.envs.serial import SerialVectorEnv
from codrl_mj.envs.snapshots import check_snapshot
from codrl_mj.envs.vector import ActuatedVectorEnv
from codrl_mj.physics import Signals


class ActuatedVecEnv(VecEnv):
    """N environments as one Stable-Baselines3 `VecEnv`; batched in MuJoCo, without a Python object for each.

    Infos are empty but for the environments whose episode ended: `terminal_observation`,
    `TimeLimit.truncated` and `episode` (return, length and time, as Stable-Baselines3's `Monitor`
    has them). What the actuators did in the last step is in `signals`, as arrays.
    """

    def __init__(self, env: ActuatedVectorEnv | SerialVectorEnv) -> None:
        """Wrap a vector environment in `SAME_STEP` mode; refused, and closed, if agents' networks do not take it."""
        seen, acts, wrong = env.single_observation_space, env.single_action_space, ""
        if not isinstance(seen, spaces.Box) or len(seen.shape) != 1:
            wrong = (
                f"observations are {seen}: must be a vector, which our agents' networks take:"
                " flatten them with a wrapper of Gymnasium's (FlattenObservation), and register"
                " that environment"
            )
        elif not isinstance(acts, spaces.Box | spaces.Discrete) or getattr(acts, "start", 0) != 0:
            wrong = (
                f"actions are {acts}: must be a vector (Box), or a choice (Discrete) that counts"
                " from 0"
            )
        elif env.autoreset_mode != AutoresetMode.SAME_STEP:
            wrong = (
                f"autoreset_mode = {env.autoreset_mode.value!r}: must be 'SameStep', as"
                " Stable-Baselines3 has it"
            )
        if wrong:
            env.close()
            raise ValueError(wrong)
        self.env = env
        self.arm_radii: np.ndarray = env.arm_radii
        """Of the motors of an environment [m], or 1 where a joint is driven directly; shape (motors,)."""
        self._actions: np.ndarray | None = None
        self._returns = np.zeros(env.num_envs)
        self._lengths = np.zeros(env.num_envs, dtype=np.int64)
        self._start = time.time()
        super().__init__(env.num_envs, seen, acts)

    def reset(self) -> np.ndarray:
        """Start an episode in every environment, with the seeds and options given since the last reset."""
        options = self._options[0]
        if any(one != options for one in self._options):
            raise ValueError(
                f"set_options: {self._options}: the environments share them: give one mapping"
            )
        observations, _ = self.env.reset(seed=self._seeds, options=options or None)
        drawn = self.env.randomization
        self.reset_infos: list[dict[str, Any]] = [
            (
                {"randomization": {name: values[row] for name, values in drawn.items()}}
                if drawn
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
        """The actuators' signals of the last step, each an array of shape (N,); None before the first."""
        return self.env.signals

    @property
    def randomization(self) -> dict[str, np.ndarray]:
        """What the present episodes were drawn with, each an array of shape (N,); empty if nothing is randomised."""
        return self.env.randomization

    def step_async(self, actions: np.ndarray) -> None:
        """Take the actions of the next step."""
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:  # type: ignore[override]
        """Step every environment; those whose episode ends start another at once."""
        assert self._actions is not None, "step_async comes first"
        observations, rewards, terminated, truncated, infos = self.env.step(self._actions)
        self._returns += rewards
        self._lengths += 1
        ended = terminated | truncated
        outcomes: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for row in np.flatnonzero(ended).tolist():
            outcomes[row] = self._outcome(
                row, infos["final_obs"][row], bool(truncated[row] and not terminated[row])
            )
        self._returns[ended], self._lengths[ended] = 0.0, 0
        return observations, rewards.astype(np.float32), ended, outcomes

    def _outcome(self, row: int, observation: np.ndarray, truncated: bool) -> dict[str, Any]:
        """The info of an environment whose episode ended."""
        return {
            "terminal_observation": observation,
            "TimeLimit.truncated": truncated,
            "episode": {
                "r": round(float(self._returns[row]), 6),
                "l": int(self._lengths[row]),
                "t": round(time.time() - self._start, 6),
            },
        }

    def conclude(
        self, observation: np.ndarray, total: float, length: int, truncated: bool, signals: Signals
    ) -> tuple[np.ndarray, list[dict[str, Any]]]:
        """Take the episode of the only environment as run elsewhere, with its last observation (k,) and sum of rewards.

        Its `length` steps have `signals` (length,) each; `truncated` by the time limit, not the
        task. The next begins.

        Returns:
            Observations and infos, as the last step would have returned them.
        """
        if self.num_envs != 1:
            raise ValueError(
                f"num_envs = {self.num_envs}: an episode can be concluded only where it is the"
                " only one"
            )
        self._returns[0], self._lengths[0] = total, length
        outcome = self._outcome(0, observation, truncated)
        observations, _ = self.env.reset()
        self.env.signals = {name: values[-1:] for name, values in signals.items()}
        self._returns[:], self._lengths[:] = 0.0, 0
        return observations, [outcome]

    def snapshot(self) -> dict[str, np.ndarray]:
        """Everything that the future depends on, as plain arrays: environments, episodes' records, pending seeds.

        The wall-clock time in `episode` goes on from where the environment was made.
        """
        return self.env.snapshot() | self._records()

    def restore(self, snapshot: Mapping[str, np.ndarray]) -> np.ndarray | None:
        """Continue from what `snapshot` returned, bit for bit, in environments made with the same arguments.

        Returns:
            None; or the first observations (N, k), where the environments could only start an
            episode anew.
        """
        own = self._records()
        check_snapshot(snapshot, self.env.snapshot() | own)
        begun = self.env.restore(
            {name: values for name, values in snapshot.items() if name not in own}
        )
        self._returns[:], self._lengths[:] = snapshot["returns"], snapshot["lengths"]
        self._seeds = [None if seed < 0 else seed for seed in snapshot["seeds"].tolist()]
        self._actions = None
        if begun is not None:
            self._returns[:], self._lengths[:] = 0.0, 0
        return begun

    def _records(self) -> dict[str, np.ndarray]:
        seeds = np.array([-1 if seed is None else seed for seed in self._seeds], dtype=np.int64)
        return {"returns": self._returns.copy(), "lengths": self._lengths.copy(), "seeds": seeds}

    def close(self) -> None:
        """Close the environments."""
        self.env.close()

    def get_images(self) -> Sequence[np.ndarray | None]:
        """An image of the first environment; nothing of the others."""
        return [self.env.image(), *[None] * (self.num_envs - 1)]

    def render(self, mode: str | None = None) -> np.ndarray | None:
        """An image of the first environment."""
        del mode
        return self.env.image()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """The attribute of the vector environment, once for each environment asked for, or else their own."""
        shared = isinstance(self.env, SerialVectorEnv) and hasattr(self.env, attr_name)
        values = (
            [getattr(self.env, attr_name)] * self.num_envs
            if shared
            else self.env.get_attr(attr_name)
        )
        return [values[index] for index in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute of the vector environment, which all share, or else that of each environment."""
        if len(list(self._get_indices(indices))) != self.num_envs:
            raise ValueError(
                f"set_attr({attr_name!r}): the environments share it; it can only be set for all of"
                " them"
            )
        owners: list[Any] = [self.env]
        if isinstance(self.env, SerialVectorEnv) and not hasattr(self.env, attr_name):
            owners = [one.unwrapped for one in self.env.envs]
        for owner in owners:
            setattr(owner, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of the vector environment once; its result stands for each of the environments asked for."""
        result = getattr(self.env, method_name)(*method_args, **method_kwargs)
        return [result for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """Whether the environments record episodes, as `Monitor` does; no other wrapper is there."""
        from stable_baselines3.common.monitor import Monitor

        return [issubclass(wrapper_class, Monitor) for _ in self._get_indices(indices)]


def make_sb3_vec_env(
    env_id: Any, num_envs: int = 64, actuator: Any = None, **arguments: Any
) -> ActuatedVecEnv:
    """Many environments as one Stable-Baselines3 `VecEnv`.

    Args:
        env_id: a Gymnasium id, such as `codrl_mj/Pendulum-v0`, or whatever else `EnvConfig.task`
            takes; an environment's whole configuration; or a function that makes an environment
            with motors, such as `functools.partial(codrl_mj.make, "Hopper-v5", {".*": "lag"})`.
        num_envs: how many, >= 1.
        actuator: as for `codrl_mj.make_vec`. A function's environments have their motors already:
            leave it out.
        **arguments: as for `codrl_mj.envs.ActuatedVectorEnv`; the time limit is Gymnasium's unless
            given. Whatever is no task of ours on `mujoco` is stepped one by one: a
            `SerialVectorEnv`.

    Raises:
        ValueError: unknown id, or an argument out of bounds; more than memory holds; observations
            are no vector, or actions neither a vector nor a choice.
    """
    given = {} if actuator is None else {"actuator": actuator}
    if callable(env_id):
        if given:
            raise ValueError(
                f"actuator = {actuator!r}: the function makes environments that have their motors:"
                " leave it out, and give functools.partial(codrl_mj.make, ENV, ACTUATOR)"
            )
        return ActuatedVecEnv(SerialVectorEnv(num_envs, env_id, **arguments))
    config = EnvConfig(env_id) if isinstance(env_id, str) else env_id
    return ActuatedVecEnv(config.make_vec(num_envs, **given, **arguments))
