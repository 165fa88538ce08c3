"""Subjects of the benchmark: simulations of codrl_mj and of other libraries."""

# isort: skip - before mujoco, which chooses its OpenGL platform when it is imported
import dataclasses
import time
from collections.abc import Callable
from typing import Any

import gymnasium
import mujoco
import numpy as np
from mujoco.batch import Batch

import codrl_mj
from codrl_mj import engine as callbacks
from codrl_mj.actuators import IDEAL
from codrl_mj.physics import SimulationConfig
from codrl_mj.physics.mjcf import install_callbacks, task_model
from codrl_mj.physics.offscreen import OffscreenRenderer
from codrl_mj.tasks import TASKS, named_actuator
from codrl_mj.validation.motor_catalogue import DriveOracle, task_drive

ACTIONS = 1000
"""Number of actions that are drawn in advance."""


@dataclasses.dataclass(frozen=True)
class Subject:
    """One thing that is timed: a simulation that takes steps."""

    name: str
    """Name in the table."""
    run: Callable[[int], None]
    """Timed function; it makes the given number of calls."""
    prepare: Callable[[], Any] = lambda: None
    """Function that is called before each turn and not timed."""
    per_call: int = 1
    """Number of environment steps (or frames) in one call."""


def engine(task: str, actuator: str | None = "paper") -> Subject:
    """Return `mj_step` of the task's model with an actuator; None: without our callbacks.

    Without callbacks the motor is dead weight and a hill is flat.

    Args:
        task: the task's name.
        actuator: `paper`; `drive`, the actuator of the task's certificate; or `stepped`, the
            same with explicit gains, which is solved substep by substep, not in closed form.
    """
    definition = TASKS[task]
    timestep = definition.step_duration / definition.motor_inner_steps
    fitted_actuator: Any = named_actuator("paper", task)
    if actuator in ("drive", "stepped"):
        fitted_actuator = task_drive(task)
    if actuator == "stepped":
        bench = DriveOracle(fitted_actuator, timestep)
        fitted_actuator = fitted_actuator.replaced(
            {
                "controller.kp": bench.kp,
                "controller.ki": bench.ki * fitted_actuator.controller.sample_rate,
            }
        )
    model = task_model(
        SimulationConfig(definition, (fitted_actuator,), definition.motor_inner_steps)
    )
    data = mujoco.MjData(model)

    def prepare() -> None:
        callbacks.uninstall()
        if actuator is not None:
            install_callbacks(model)
        mujoco.mj_resetData(model, data)
        # The pendulum is in motion with and without motors: at rest, a step is cheaper.
        data.qpos[:] = 0.3
        data.qvel[:] = 0.1
        data.ctrl[:] = model.actuator_ctrlrange[0, 1] / 2

    name = "mj_step, bare" if actuator is None else f"mj_step with our callbacks, {actuator}"
    return Subject(name, lambda calls: mujoco.mj_step(model, data, calls), prepare)


def chain(motors: int, actuator: str | None, substeps: int = 10) -> Subject:
    """Return `mj_step` of a chain of links with a motor in every joint; None: MuJoCo's."""
    spec = mujoco.MjSpec()
    body = spec.worldbody
    for index in range(motors):
        body = body.add_body(pos=[0.0, 0.0, -0.1])
        joint = body.add_joint(name=f"joint{index}", axis=[0.0, 1.0, 0.0], damping=[0.1, 0.0, 0.0])
        body.explicitinertial, body.mass, body.inertia = True, 0.1, [0.01, 0.01, 0.01]
        motor = spec.add_actuator(
            name=f"motor{index}", target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT
        )
        motor.set_to_motor()
    custom_actuators: Any = {
        "current_loop": codrl_mj.actuators.DCMotorActuator(
            controller=codrl_mj.actuators.CurrentLoop(ki=1.0, substeps=substeps)
        )
    }
    if actuator is not None:
        spec = codrl_mj.add_motors(spec, {".*": custom_actuators.get(actuator, actuator)})
    model = spec.compile()
    data = mujoco.MjData(model)

    def prepare() -> None:
        mujoco.mj_resetData(model, data)
        data.ctrl[:] = 0.1

    name = f"{motors} motors, {'as they are' if actuator is None else actuator}"
    return Subject(name, lambda calls: mujoco.mj_step(model, data, calls), prepare)


def single(name: str, env: Any) -> Subject:
    """Return the steps of a Gymnasium environment under random actions, with resets."""
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(ACTIONS)]

    def run(calls: int) -> None:
        for index in range(calls):
            _, _, terminated, truncated, _ = env.step(actions[index % ACTIONS])
            if terminated or truncated:
                env.reset()

    # If the environment is ours, the reset installs our callbacks.
    return Subject(name, run, lambda: env.reset(seed=0))


def ours(task: str, actuator: str) -> Subject:
    """Return our environment, made by `gym.make`."""
    env = gymnasium.make(TASKS[task].env_id, actuator=actuator, disable_env_checker=True)
    return single(f"ours, actuator {actuator!r}", env)


def gymnasium_env(env_id: str) -> Subject:
    """Return a Gymnasium environment."""
    return single(f"Gymnasium {env_id}", gymnasium.make(env_id, disable_env_checker=True))


def foreign(env_id: str, actuator: str | None) -> Subject:
    """Return a Gymnasium environment with added motors; None: with its own actuators."""
    if actuator is None:
        return gymnasium_env(env_id)
    return single(
        actuator,
        codrl_mj.make(env_id, {".*": actuator}, allow_unstable=True, disable_env_checker=True),
    )


def without_motors(env_id: str, actuator: str) -> Subject:
    """Return an environment with the inertia and friction that an actuator adds, but no motors."""
    env = gymnasium.make(env_id, disable_env_checker=True)
    plain: Any = env.unwrapped
    actuated: Any = codrl_mj.make(env_id, {".*": actuator}, allow_unstable=True).unwrapped
    model = actuated.model
    # The engine's cost depends on these fields too, so they are the same with and without motors.
    for field in (
        "actuator_armature",
        "actuator_damping",
        "dof_frictionloss",
        "tendon_frictionloss",
    ):
        getattr(plain.model, field)[:] = getattr(model, field)
    mujoco.mj_setConst(plain.model, plain.data)
    return single(f"inertia and friction of {actuator}, no motors", env)


def dm_control(domain: str, task: str) -> Subject:
    """Return a task of dm_control's suite."""
    from dm_control import suite

    env = suite.load(domain, task, task_kwargs={"random": 0})
    spec, generator = env.action_spec(), np.random.default_rng(0)
    actions = generator.uniform(spec.minimum, spec.maximum, (ACTIONS, *spec.shape))

    def run(calls: int) -> None:
        for index in range(calls):
            if env.step(actions[index % ACTIONS]).last():
                env.reset()

    def prepare() -> None:
        callbacks.uninstall()
        env.reset()

    return Subject(f"dm_control {domain} {task}", run, prepare)


def electric_motor() -> Subject:
    """Return gym-electric-motor's DC motor with permanent magnets under current control.

    It simulates a motor, but no mechanics of a task.
    """
    import gym_electric_motor

    return single(
        "gym-electric-motor Cont-CC-PermExDc-v0", gym_electric_motor.make("Cont-CC-PermExDc-v0")
    )


def batched(name: str, env: Any) -> Subject:
    """Return the steps of any library's vector environment under random actions."""
    generator, space = np.random.default_rng(0), env.unwrapped
    # EnvPool has no `num_envs`, and its length is the number of environments.
    count = getattr(space, "num_envs", None) or len(env)
    action_space = getattr(env, "single_action_space", env.action_space)
    if isinstance(action_space, gymnasium.spaces.Discrete):
        actions = list(generator.integers(action_space.n, size=(20, count)))
    else:
        actions = list(
            generator.uniform(
                action_space.low, action_space.high, (20, count, *action_space.shape)
            ).astype(action_space.dtype)
        )

    def run(calls: int) -> None:
        for index in range(calls):
            env.step(actions[index % 20])

    return Subject(name, run, env.reset, per_call=count)


def vector(task: str, num_envs: int, threads: int, actuator: str = "paper") -> Subject:
    """Return our vector environment."""
    env = gymnasium.make_vec(
        TASKS[task].env_id, num_envs, "vector_entry_point", num_threads=threads, actuator=actuator
    )
    return batched(f"ours, N = {num_envs}, threads = {threads}, actuator {actuator!r}", env)


def raw_batch(task: str, num_envs: int, threads: int, calls_apart: bool) -> Subject:
    """Return `Batch.step` of the same model with its motor: all inner steps in one call, or not."""
    env: Any = gymnasium.make_vec(
        TASKS[task].env_id, num_envs, "vector_entry_point", num_threads=threads
    )
    env.reset(seed=0)
    env.step(np.zeros(env.action_space.shape, env.action_space.dtype))
    physics = env.unwrapped.physics
    batch = Batch(physics.model, num_envs, threads)
    start = physics.snapshot()
    inner_steps = physics.simulation.inner_steps

    def prepare() -> None:
        install_callbacks(physics.model)
        batch.state[:] = start

    def run(calls: int) -> None:
        for _ in range(calls):
            if calls_apart:
                for _ in range(inner_steps):
                    batch.step()
            else:
                batch.step(nstep=inner_steps)

    name = f"Batch.step x {inner_steps}" if calls_apart else f"Batch.step(nstep={inner_steps})"
    return Subject(f"{name}, N = {num_envs}, threads = {threads}", run, prepare, per_call=num_envs)


def envpool(env_id: str, num_envs: int, threads: int) -> Subject:
    """Return an environment of EnvPool."""
    import envpool as library

    env = library.make(env_id, env_type="gymnasium", num_envs=num_envs, num_threads=threads, seed=0)
    return batched(f"EnvPool {env_id}, N = {num_envs}, threads = {threads}", env)


def drawing(task: str, fast: bool) -> Subject:
    """Return the rendering of 480 x 480 frames, with our fast settings or MuJoCo's defaults."""
    model = task_model(SimulationConfig(TASKS[task], (IDEAL,)))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    if fast:
        renderer = OffscreenRenderer(model)

        def run(frames: int) -> None:
            for _ in range(frames):
                renderer.render(data)

        return Subject("frames with our settings", run)
    # These are MuJoCo's defaults, which our tasks' models lower.
    model.vis.quality.shadowsize, model.vis.quality.offsamples = 4096, 4
    default = mujoco.Renderer(model, 480, 480)

    def run_default(frames: int) -> None:
        for _ in range(frames):
            default.update_scene(data, "fixed")
            default.render()

    return Subject("frames with MuJoCo's defaults", run_default)


class Stopwatch:
    """Sum of the time that is spent in a `VecEnv`'s steps."""

    def __init__(self, env: Any) -> None:
        """Start to time the steps of `env`."""
        self.seconds = 0.0
        self._step_wait = env.step_wait
        env.step_wait = self._timed

    def _timed(self) -> Any:
        start = time.perf_counter()
        result = self._step_wait()
        self.seconds += time.perf_counter() - start
        return result


def ppo(num_envs: int, batched_ours: bool) -> tuple[str, Callable[[int], float]]:
    """Return Stable-Baselines3's PPO on Pendulum: a name, and a function that trains.

    The function trains for some steps and returns the share of time spent in the environment.
    """
    import torch
    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env import DummyVecEnv

    torch.set_num_threads(1)
    if batched_ours:
        env: Any = codrl_mj.make_sb3_vec_env(TASKS["pendulum"].env_id, num_envs)
    else:
        env = DummyVecEnv([lambda: gymnasium.make("Pendulum-v1")] * num_envs)
    watch = Stopwatch(env)
    model = PPO(
        "MlpPolicy",
        env,
        n_steps=2048 // num_envs,
        batch_size=256,
        n_epochs=10,
        seed=0,
        device="cpu",
    )

    def train(steps: int) -> float:
        watch.seconds, start = 0.0, time.perf_counter()
        model.learn(steps)
        return watch.seconds / (time.perf_counter() - start)

    name = "ours, motor, N = " if batched_ours else "Gymnasium Pendulum-v1 in DummyVecEnv, N = "
    return f"{name}{num_envs}", train
