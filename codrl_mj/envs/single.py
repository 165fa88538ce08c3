"""A single task environment with the interface of Gymnasium."""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import gymnasium
import mujoco
import numpy as np

from codrl_mj.actuators import IDEAL, ActuatorModel
from codrl_mj.boundary import Action, Argument, AttributeValue, Info, PickledState
from codrl_mj.envs.attributes import (
    AttributeOwner,
    GymnasiumAttributes,
    read,
    validate_states,
    write,
)
from codrl_mj.envs.compiled import CompiledStep, bind_observation, compiled_kernels
from codrl_mj.envs.config import EnvConfig
from codrl_mj.envs.setup import ResolvedEnv, task_config, unwrap_single
from codrl_mj.envs.snapshots import check_snapshot, encode_name, generator_from_words
from codrl_mj.envs.task_bank import TaskBank
from codrl_mj.physics import MujocoPhysics, SimulationConfig
from codrl_mj.physics.base import Force, Physics, Scene, Signals
from codrl_mj.physics.offscreen import DisplayWindow, OffscreenRenderer, check_view
from codrl_mj.physics.streams import generator_words
from codrl_mj.tasks import Task


class BoundStep(NamedTuple):
    """A task's compiled step, bound to one simulation."""

    force_of: Callable[[Action], Force]
    """(action) -> desired force [N or N*m]."""
    step: CompiledStep
    """`Kernels.step`: (force, pointers) -> (reward, terminated, is_finite). It fills `observation`
    and the trace.
    """
    pointers: int
    """Address of the simulation's table of pointers."""
    observation: np.ndarray
    """Observation, shape (k,), float32; the next step overwrites it."""
    read_columns: Callable[[], Sequence[object] | np.ndarray]
    """Return a copy of the last row of the trace: a number or array for each column."""
    name_signals: Callable[[Sequence[object] | np.ndarray, Force], Signals]
    """(columns, force) -> `info` of the step."""


class ActuatedEnv(GymnasiumAttributes, gymnasium.Env[np.ndarray, Action]):
    """A classic-control task whose actions go through an actuator.

    Observation, action, reward, initial states and termination are those of Gymnasium's task. The
    difference is the force: the action selects the desired force, and the actuator delivers the
    actual force. With `actuator="ideal"` both are equal, and the environment is a
    drop-in replacement for Gymnasium's.

    Every step's `info` has `desired_force`, `actual_force` [N or N*m], the signals of the
    actuator's family and `saturated` (bool), each at the end of the step. A current loop has the
    signals `current`, `reference_current` [A] and `voltage` [V], which are 0 for an ideal actuator;
    a drive also reports which limit it reached (`codrl_mj.actuators.drive`). If the agent commands
    the voltage, `desired_force` equals the delivered force. With several motors each signal is an
    array (n,).
    """

    # Class attribute, as in Gymnasium; an instance replaces it and never changes it.
    metadata: Info = {  # noqa: RUF012
        "render_modes": ["human", "rgb_array"],
        "render_fps": 50,
    }

    def __init__(
        self,
        task: str | EnvConfig,
        actuator: object = None,
        render_mode: str | None = None,
        width: int = 480,
        height: int = 480,
        camera: str = "fixed",
        pretty: bool = False,
        **arguments: Argument,
    ) -> None:
        """Build the environment.

        Args:
            task: the task's name, such as `cartpole`; or a configuration.
            actuator: actuator that delivers the force, as for `EnvConfig.actuator`; None for the
                task's or the configuration's own.
            render_mode: None; `rgb_array`: `render` returns images; `human`: pygame shows every
                step in a window. `gymnasium.make` warns of other modes, and `render` refuses them.
            width: width of rendered images [px].
            height: height of rendered images [px].
            camera: a camera of the model: `fixed` or `close`.
            pretty: True to render shadows, reflections and multisampling.
            **arguments: the other fields of `codrl_mj.EnvConfig`, such as `physics`,
                `observe_actuator` and `randomize`, and options of the task (CartPole:
                `center_radius`, `sutton_barto_reward`).

        Raises:
            ValueError: an argument is unknown or out of bounds, or the current loop is unstable;
                the message names it.
            CallbackInUseError: another library's MuJoCo callback is installed.
        """
        config = task_config(task, actuator, arguments)
        setup = ResolvedEnv.build(config)
        self.physics = setup.simulate()
        self.bank = TaskBank(setup, self.physics, [setup.simulation.actuators])
        """The actuators: their commands, draws, sensors and signals."""
        self.render_mode = render_mode
        self.metadata = {**self.metadata, "render_fps": setup.task.render_fps}
        self._view = {"width": width, "height": height, "camera": camera, "pretty": pretty}
        self._renderer: OffscreenRenderer | None = None
        self._window: DisplayWindow | None = None
        self._fallback_scene: MujocoPhysics | None = None
        if render_mode is not None:
            check_view(self._scene()[1][0], width, height, camera)
        self.action_space = self.bank.action_space
        self.observation_space = setup.observation_space
        self.observation_names, self.motor_names = setup.observation_names, self.task.motors
        self.command = config.action
        """Name of the agent's command."""
        self.signal_names, self.trace_names = self.bank.signal_names, self.bank.trace_names
        """Names of the actuators' signals in `info`, and of the columns of `trace`."""
        self._bound_step: BoundStep | None = None
        self._offer_attributes(self.task)

    @property
    def setup(self) -> ResolvedEnv:
        """Everything that follows from the configuration and the attributes that were written."""
        return self.bank.setup

    @property
    def task(self) -> Task:
        """The task."""
        return self.setup.task

    @property
    def actuator(self) -> ActuatorModel | tuple[ActuatorModel, ...]:
        """Actuator of the present episode; for several motors a tuple."""
        return unwrap_single(tuple(self.bank.motors.values()))

    @property
    def motors(self) -> dict[int, ActuatorModel]:
        """Motor index of the task -> actuator of the present episode."""
        return self.bank.motors

    @property
    def model(self) -> mujoco.MjModel:
        """The `mujoco.MjModel` (MuJoCo physics only); one `mj_step` is one integration step."""
        return self._engine()[0]

    @property
    def data(self) -> mujoco.MjData:
        """The `mujoco.MjData` (MuJoCo physics only)."""
        return self._engine()[1]

    @property
    def state(self) -> np.ndarray:
        """Mechanical state, (n,), float64, as in Gymnasium; setting keeps the motor's state."""
        return self.physics.state.copy()

    @state.setter
    def state(self, state: object) -> None:
        self.physics.state = validate_states(state, self.physics.state.shape)

    @property
    def recorder(self) -> "ActuatedEnv":
        """Object with the signals of each integration step: the environment itself."""
        return self

    @property
    def speeds(self) -> np.ndarray:
        """Velocities of the joints that motors drive [m/s or rad/s], shape (motors,)."""
        return self.physics.state[list(self.task.speed_indices)]

    @property
    def trace(self) -> np.ndarray:
        """Signals of each integration step of the last step; see `codrl_mj.physics.Physics`."""
        return self.physics.trace.copy()

    @property
    def step_duration(self) -> float:
        """Duration of an environment step [s]."""
        return self.task.step_duration

    def pose(self) -> None:
        """Update the bodies' poses in `data`, which lag one integration step behind."""
        self.physics.show(self.physics.state)

    def _engine(self) -> Scene:
        if self.physics.scene is None:
            raise AttributeError(
                f"{type(self.physics).__name__} has no MuJoCo model or data; use physics='mujoco'"
            )
        return self.physics.scene

    def _attribute_target(self) -> AttributeOwner:
        """Return the object that `read` and `write` of attributes take as the model."""
        return self.physics if self.physics.scene is None else self.physics.scene[0]

    def _read_attribute(self, name: str) -> AttributeValue:
        return read(name, self.setup, self._attribute_target())

    def _write_attribute(self, name: str, value: AttributeValue) -> None:
        physics = self.physics
        snapshot = physics.snapshot()
        self.bank.setup = write(name, value, self.setup, self._attribute_target())
        self._bound_step = None
        physics.set_model({})
        physics.restore(snapshot)

    def reset(
        self, *, seed: int | None = None, options: Info | None = None
    ) -> tuple[np.ndarray, Info]:
        """Start an episode, with the motor at rest.

        Args:
            seed: seed of the initial state; it gives the same state as in Gymnasium's environment.
            options: Gymnasium's reset options for the task (CartPole: bounds `low` and `high`).
        """
        super().reset(seed=seed)
        generator, setup = self.np_random, self.setup
        initial = setup.task.draw_initial_state(generator, options)
        self.bank.randomization.draw_single(generator)
        self.physics.reset(initial, self.bank.key(generator))
        if self.render_mode == "human":
            self.render()
        drawn_values = self.randomization
        return (
            self._observation(None),
            {"randomization": drawn_values} if drawn_values else {},
        )

    def step(self, action: Action) -> tuple[np.ndarray, float, bool, bool, Info]:
        """Advance by one environment step.

        Args:
            action: an element of the action space; a continuous action outside its bounds
                saturates.

        Raises:
            ValueError: the action is not in the action space, or NaN.
            SimulationDivergedError: a value of the simulation is not finite.
        """
        if self._bound_step is None:
            if self.physics.stepping is None:
                return self._step_in_python(self.bank.force(action))
            self._bound_step = self._bind_step()
        # A named tuple is unpacked faster than its fields are read one by one.
        force_of, step, pointers, observation, read_columns, name_signals = self._bound_step
        force = force_of(action)
        reward, terminated, is_finite = step(force, pointers)
        if not is_finite:
            self.physics.check_finite()
        if self.render_mode == "human":
            self.render()
        return observation.copy(), reward, terminated, False, name_signals(read_columns(), force)

    def _bind_step(self) -> "BoundStep":
        """Connect the compiled step to the arrays that it reads and fills."""
        row = self.physics.trace[-1]
        return BoundStep(
            self.bank.force,
            compiled_kernels(self.setup, self.physics).step,
            *bind_observation(self.setup, self.physics),
            row[0].tolist if len(row) == 1 else row.T.copy,
            self.bank.signals,
        )

    def _observation(self, row: np.ndarray | None) -> np.ndarray:
        """Return the observation (k,), float32; `row` is the last row of the trace, or None."""
        observation = self.setup.observation(self.physics.state)
        if not self.bank.sensors:
            return observation
        return np.append(observation, self.bank.sensor_values(row)).astype(np.float32)

    def _step_in_python(self, force: Force) -> tuple[np.ndarray, float, bool, bool, Info]:
        """Take a step without the compiled function, for a physics in Python."""
        physics, setup = self.physics, self.setup
        before = physics.state
        physics.step(force)
        row, after = physics.trace[-1], physics.state
        info = self.bank.signals(row.T.copy() if len(row) > 1 else row[0].tolist(), force)
        if self.render_mode == "human":
            self.render()
        reward, terminated = setup.outcome(before, info["actual_force"], after)
        return self._observation(row), reward, terminated, False, info

    @property
    def randomization(self) -> Info:
        """Drawn values of the present episode, as in the reset's info; NaN before a reset."""
        return self.bank.randomization.report()

    def snapshot(self) -> dict[str, np.ndarray]:
        """Return the complete state as arrays: simulation, motor, generator, drawn values.

        Generators of the spaces and counts of wrappers are not included.
        """
        return {
            "task": encode_name(self.task.name),
            "physics": self.physics.snapshot(),
            "generator": generator_words(self.np_random),
            # The bank has a row for each simulation.
            **{name: np.array(rows[0]) for name, rows in self.bank.snapshot().items()},
        }

    def restore(self, snapshot: Mapping[str, np.ndarray]) -> None:
        """Continue from a snapshot, bit for bit, in an environment made with the same arguments.

        Raises:
            ValueError: the snapshot is of another task, or of arguments that need other entries or
                shapes; nothing was changed.
        """
        check_snapshot(snapshot, self.snapshot(), "task")
        self.bank.restore(snapshot)
        self.physics.restore(snapshot["physics"])
        self.np_random = generator_from_words(snapshot["generator"])

    def render(self) -> np.ndarray | None:
        """Render the state as an image (height, width, 3), uint8; None unless mode is `rgb_array`.

        Raises:
            ValueError: unknown render mode.
            DependencyNotInstalled: a window needs pygame.
            RenderingUnavailableError: there is no OpenGL context; the message has the remedy.
        """
        if self.render_mode is None:
            gymnasium.logger.warn(
                "render() without a render mode: pass render_mode='rgb_array' when making it"
            )
            return None
        if self.render_mode not in self.metadata["render_modes"]:
            raise ValueError(
                f"render_mode = {self.render_mode!r}: must be None, 'human' or 'rgb_array'"
            )
        physics, (model, data) = self._scene()
        if self._renderer is None:
            self._renderer = OffscreenRenderer(model, **self._view)  # type: ignore[arg-type]
        physics.show(self.physics.state)
        image = self._renderer.render(data)
        if self.render_mode == "rgb_array":
            return image
        if self._window is None:
            self._window = DisplayWindow(image.shape[1], image.shape[0])
        self._window.show(image, self.metadata["render_fps"])
        return None

    def _scene(self) -> tuple[Physics, Scene]:
        """Return the physics to render; if it has no scene, a simulation with ideal actuators."""
        if self.physics.scene is not None:
            return self.physics, self.physics.scene
        if self._fallback_scene is None:
            self._fallback_scene = MujocoPhysics(
                SimulationConfig(
                    self.task, [IDEAL] * len(self.task.motors), options=self.setup.config.options
                )
            )
        return self._fallback_scene, self._fallback_scene.scene

    def close(self) -> None:
        """Free the OpenGL context, and close the window."""
        for resource in (self._renderer, self._window):
            if resource is not None:
                resource.close()
        self._renderer = self._window = self._fallback_scene = None

    def __getstate__(self) -> PickledState:
        """Return all but the renderer, the window and the compiled step; a copy makes new ones."""
        return self.__dict__ | {
            "_renderer": None,
            "_window": None,
            "_fallback_scene": None,
            "_bound_step": None,
        }
