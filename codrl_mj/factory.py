"""Creation of single and vectorized environments: `make` and `make_vec`."""

from collections.abc import Callable

from codrl_mj.boundary import Argument
from codrl_mj.envs.config import Env, EnvConfig, VecEnv


def make(
    env: str | EnvConfig | Callable[..., Env], actuator: object = None, **arguments: Argument
) -> Env:
    """Create an environment with motors behind its actuators.

        >>> env = codrl_mj.make("pendulum", "maxon-dcx22l")
        >>> env = codrl_mj.make("HalfCheetah-v5", {"b.*": "maxon-ec45-flat-50w", "f.*": "lag"})

    For a library that makes environments in other processes, pass a function, such as
    `functools.partial(codrl_mj.make, "Hopper-v5", "lag")`.

    Args:
        env: a task's name or id, such as `pendulum`; the id of a third-party environment;
            `module:NAME` of a custom task or env source; an `EnvConfig`; or a function or class
            that makes an environment, which needs no id.
        actuator: actuator that delivers the forces: a name, an `ActuatorModel`, or a mapping from
            patterns of motor names to these. None selects the default motor of a task, and no motor
            in other environments. With `"ideal"`, an environment behaves, bit for bit, as it does
            without motors.
        **arguments: other fields of `EnvConfig`, options of the task or of the environment's
            constructor, and arguments of `gymnasium.make`, such as `render_mode`.

    Raises:
        ValueError: there is no such environment, a name or an argument is unknown, or arguments
            contradict each other; the message has the remedy.
    """
    config, remaining = EnvConfig.of(env, actuator, arguments)
    return config.build(**remaining)


def make_vec(
    env: str | EnvConfig | Callable[..., Env],
    num_envs: int = 1,
    actuator: object = None,
    **arguments: Argument,
) -> VecEnv:
    """Create a Gymnasium vector environment, by default in autoreset mode `SameStep`.

        >>> randomize = {"motor.resistance": "uniform(1, 2)"}
        >>> envs = codrl_mj.make_vec("pendulum", 1024, "weak", randomize=randomize)

    A task on MuJoCo becomes an `ActuatedVectorEnv`, which steps all environments as a batch, in
    threads. Everything else (third-party environments, functions, `physics="analytic"`) becomes a
    `SerialVectorEnv`, which steps one environment after the other. So does a task on MuJoCo with
    `render_mode="human"`, and a warning says that this is slow.

    Args:
        env: as for `make`.
        num_envs: number of environments, >= 1.
        actuator: as for `make`; for a task also a list with one actuator for each environment.
        **arguments: as for `make`, and arguments of the vector environment: `num_threads` (only for
            a batch), `autoreset_mode`, `render_mode`. They have the same meaning with a name and
            with an `EnvConfig`.

    Raises:
        ValueError: see `make`; or there is too little memory.
    """
    config = EnvConfig.of(env)[0]
    actuator_argument = {} if actuator is None else {"actuator": actuator}
    return config.build_vec(num_envs, **actuator_argument, **arguments)
