"""One environment, as Gymnasium knows it."""

import functools
from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np

from codrl_mj.actuators import IDEAL
from codrl_mj.envs.attributes import GymnasiumAttributes, checked_states, read, written
from codrl_mj.envs.compiled import bound, compiled_kernels
from codrl_mj.envs.config import EnvConfig
from codrl_mj.envs.randomization import RandomizationState, apply_to_simulation
from codrl_mj.envs.setup import ResolvedEnv, alone
from codrl_mj.envs.snapshots import check_snapshot, encode_name, generator_of
from codrl_mj.physics import MujocoPhysics, SimulationConfig, signal_names, trace_names
from codrl_mj.physics.offscreen import OffscreenRenderer, Window, check_view
from codrl_mj.physics.streams import generator_words
from codrl_mj.tasks import Task


class ActuatedEnv(GymnasiumAttributes, gymnasium.Env[np.ndarray, Any]):
    """A classic-control task whose actions go through an actuator.

    Observation, action, reward, start and end are Gymnasium's for the task; what differs is the
    force: the action chooses the desired one, the actuator delivers the actual one. With
    `actuator="ideal"` they are equal and the environment is a drop-in for Gymnasium's.

    Every step's `info` has `desired_force`, `actual_force` [N or N*m], the signals of the
    actuator's family and `saturated` (bool), each at the end of the step: of a current loop
    `current`, `reference_current` [A] and `voltage` [V], which are 0 where the actuator is ideal; a
    drive also says which limit it met (`codrl_mj.actuators.drive`). Where the agent commands the
    voltage, what is delivered is what is desired. Of several motors each is an array (n,).
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 - as Gymnasium has it
        "render_modes": ["human", "rgb_array"],
        "render_fps": 50,
    }

    def __init__(
        self,
        task: str,
        actuator: Any = "default",
        physics: str = "mujoco",
        render_mode: str | None = None,
        width: int = 480,
        height: int = 480,
        camera: str = "fixed",
        pretty: bool = False,
        **arguments: Any,
    ) -> None:
        """Build the environment.

        Args:
            task: the task's name, such as `cartpole`.
            actuator: what the force goes through, as `EnvConfig.actuator` says.
            physics: `mujoco`, `analytic` (Gymnasium's own equations, or a closed form), or one's
                own.
            render_mode: None; `rgb_array`: `render` returns images; `human`: pygame shows every
                step in a window. Others, of which `gymnasium.make` warns, are refused when they are
                rendered.
            width: width of rendered images [px].
            height: height of rendered images [px].
            camera: a camera of the model: `fixed` or `close`.
            pretty: shadows, reflections and multisampling.
            **arguments: the other fields of `codrl_mj.envs.config.EnvConfig`: `integrator`,
                `inner_steps`, `timestep`, `allow_unstable`, `action`, `levels`, `observe_actuator`,
                `disturbances`, `joint`, `randomize`; and the task's own options (CartPole:
                `center_radius`, `sutton_barto_reward`).

        Raises:
            ValueError: an argument is unknown or out of bounds, or the current loop is unstable;
                the message names it.
            CallbackInUseError: another library's MuJoCo callback is installed.
        """
        config = EnvConfig.of(task, actuator, {"physics": physics, **arguments})
        self.setup = ResolvedEnv.build(config)
        self.physics = self.setup.simulate()
        into = functools.partial(apply_to_simulation, self.physics)
        self._draws = RandomizationState(
            self.setup.randomization, [self.setup.plant.actuators], into
        )
        self.render_mode = render_mode
        self.metadata = {**self.metadata, "render_fps": self.setup.task.render_fps}
        self._view = {"width": width, "height": height, "camera": camera, "pretty": pretty}
        self._renderer: OffscreenRenderer | None = None
        self._window: Window | None = None
        self._shown: Any = None
        if render_mode is not None:
            check_view(self._scene().scene[0], width, height, camera)
        self.action_space = self.setup.commands.action_space
        self.observation_space = self.setup.observation_space
        self.observation_names, self.motor_names = self.setup.observation_names, self.task.motors
        self.command = config.action
        """What the agent commands."""
        self.signal_names, self.trace_names = (
            signal_names(family := self.setup.plant.family),
            trace_names(family),
        )
        """Of the actuators' signals in `info`; of the columns of `trace`."""
        self._compiled: tuple[Any, ...] | None = None
        self._offer_attributes(self.task)

    @property
    def task(self) -> Task:
        """The task."""
        return self.setup.task

    @property
    def actuator(self) -> Any:
        """The actuator, of the present episode where it is drawn; with several motors a tuple of them."""
        return alone(self._draws.motors(0, self.setup.config.actuators))

    @property
    def motors(self) -> dict[int, Any]:
        """The actuators of the present episode, by the number of the task's motor."""
        return dict(enumerate(self._draws.motors(0, self.setup.config.actuators)))

    @property
    def model(self) -> Any:
        """The `mujoco.MjModel` (MuJoCo physics only); one `mj_step` of it is one integration step."""
        return self._engine()[0]

    @property
    def data(self) -> Any:
        """The `mujoco.MjData` (MuJoCo physics only)."""
        return self._engine()[1]

    @property
    def state(self) -> np.ndarray:
        """The mechanical state, shape (n,), float64, in Gymnasium's order; set, it moves there, the motor as it is."""
        return self.physics.state.copy()

    @state.setter
    def state(self, state: Any) -> None:
        self.physics.state = checked_states(state, self.physics.state.shape)

    @property
    def recorder(self) -> "ActuatedEnv":
        """What reads the environment between its steps: itself."""
        return self

    @property
    def speeds(self) -> np.ndarray:
        """Velocities of the joints that the motors drive [m/s or rad/s], shape (motors,)."""
        return self.physics.state[list(self.task.speeds)]

    @property
    def trace(self) -> np.ndarray:
        """What the motors did in each integration step of the last step; see `codrl_mj.physics.Physics.trace`."""
        return self.physics.trace.copy()

    @property
    def step_duration(self) -> float:
        """[s]."""
        return self.task.step_duration

    def pose(self) -> None:
        """Bring the bodies of `data` to the present state: the engine leaves them where its last step began."""
        self.physics.show(self.physics.state)

    def _engine(self) -> tuple[Any, Any]:
        if self.physics.scene is None:
            raise AttributeError(
                f"{type(self.physics).__name__} has no MuJoCo model or data; use physics='mujoco'"
            )
        return self.physics.scene

    def _model(self) -> Any:
        """What has the numbers of the model, for `read` and `written`."""
        return self.physics if self.physics.scene is None else self.physics.scene[0]

    def _read_attribute(self, name: str) -> Any:
        return read(name, self.setup, self._model())

    def _write_attribute(self, name: str, value: Any) -> None:
        physics = self.physics
        kept = physics.snapshot()
        self.setup, self._compiled = written(name, value, self.setup, self._model()), None
        physics.set_model({})
        physics.restore(kept)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode; the motor is at rest.

        Args:
            seed: seed of the initial state; the same seed draws the state that Gymnasium's
                environment draws.
            options: Gymnasium's reset options for the task (CartPole: the bounds `low` and `high`).
        """
        super().reset(seed=seed)
        generator, setup = self.np_random, self.setup
        initial = setup.task.initial(generator, options)
        self._draws.draw_one(generator)
        self.physics.reset(
            initial, float(setup.keys(lambda count: generator.random((1, count)))[0])
        )
        if self.render_mode == "human":
            self.render()
        drawn = self.randomization
        return self.setup.observation(self.physics), {"randomization": drawn} if drawn else {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Advance by one environment step.

        Args:
            action: an element of the action space; a continuous one may lie outside its bounds,
                where the desired force saturates.

        Raises:
            ValueError: the action is not in the action space, or not a number.
            SimulationDivergedError: the simulation left the finite numbers.
        """
        if self._compiled is None:
            if self.physics.stepping is None:
                return self._step_apart(self.setup.commands.force(action))
            self._compiled = self._parts()
        force_of, step, where, seen, columns, signals = self._compiled
        force = force_of(action)
        reward, terminated, fine = step(force, where)
        if not fine:
            self.physics.check_finite()
        if self.render_mode == "human":
            self.render()
        return seen.copy(), reward, terminated, False, signals(columns(), force)

    def _parts(self) -> tuple[Any, ...]:
        """What a step takes: from action to force, the compiled step with its arguments, and from trace to signals."""
        setup, row = self.setup, self.physics.trace[-1]
        columns = row[0].tolist if len(row) == 1 else row.T.copy
        compiled = compiled_kernels(setup, self.physics).step, *bound(setup, self.physics)
        return setup.commands.force, *compiled, columns, setup.signals

    def _step_apart(self, force: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """What the compiled step does, in parts, for a physics that is Python."""
        physics, setup = self.physics, self.setup
        before = physics.state
        physics.step(force)
        row, after = physics.trace[-1], physics.state
        info = setup.signals(row.T.copy() if len(row) > 1 else row[0].tolist(), force)
        if self.render_mode == "human":
            self.render()
        reward, terminated = setup.outcome(before, info["actual_force"], after)
        return setup.observation(physics, physics.trace[-1]), reward, terminated, False, info

    @property
    def randomization(self) -> dict[str, Any]:
        """What the present episode was drawn with, as in the reset's info: NaN before it, empty without draws."""
        return self._draws.report()

    def snapshot(self) -> dict[str, np.ndarray]:
        """Everything that the future depends on, as plain arrays: simulation, motor, generator, what was drawn.

        The generators of the spaces, and what wrappers count, are theirs.
        """
        everything = {
            "task": encode_name(self.task.name),
            "physics": self.physics.snapshot(),
            "generator": generator_words(self.np_random),
        }
        if self.physics.memory.size:
            everything["disturbances"] = self.physics.memory.copy()
        return everything | {
            name: np.array(rows[0]) for name, rows in self._draws.snapshot().items()
        }

    def restore(self, snapshot: Mapping[str, np.ndarray]) -> None:
        """Continue from what `snapshot` returned, bit for bit, in an environment made with the same arguments.

        Raises:
            ValueError: the snapshot is of another task, or of arguments that need other entries or
                shapes; nothing was changed.
        """
        check_snapshot(snapshot, self.snapshot(), "task")
        self._draws.restore(snapshot)
        self.physics.restore(snapshot["physics"])
        self.physics.memory[:] = snapshot.get("disturbances", 0.0)
        self.np_random = generator_of(snapshot["generator"])

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """The present state as an image, shape (height, width, 3), uint8; None in a window or without a render mode.

        Raises:
            ValueError: unknown render mode.
            DependencyNotInstalled: a window needs pygame.
            RenderingUnavailableError: no OpenGL context can be made here; the message has the
                remedy.
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
        scene = self._scene()
        model, data = scene.scene
        if self._renderer is None:
            self._renderer = OffscreenRenderer(model, **self._view)  # type: ignore[arg-type]
        scene.show(self.physics.state)
        image = self._renderer.render(data)
        if self.render_mode == "rgb_array":
            return image
        if self._window is None:
            self._window = Window(image.shape[1], image.shape[0])
        self._window.show(image, self.metadata["render_fps"])
        return None

    def _scene(self) -> Any:
        """What is drawn: the simulation itself, or the task's ideal model where the physics has none."""
        if self.physics.scene is not None:
            return self.physics
        if self._shown is None:
            self._shown = MujocoPhysics(
                SimulationConfig(self.task, [IDEAL] * len(self.task.motors))
            )
        return self._shown

    def close(self) -> None:
        """Free the OpenGL context, and close the window."""
        for shown in (self._renderer, self._window):
            if shown is not None:
                shown.close()
        self._renderer = self._window = self._shown = None

    def __getstate__(self) -> dict[str, Any]:
        """Everything but the renderer, the window and the compiled step, which a copy makes anew."""
        return self.__dict__ | {
            "_renderer": None,
            "_window": None,
            "_shown": None,
            "_compiled": None,
        }
