"""One environment, as Gymnasium knows it."""

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.utils import seeding

from codrl_mj.disturbances import Disturbances
from codrl_mj.envs.compiled import arguments, compiled_kernels
from codrl_mj.envs.distributions import Distribution
from codrl_mj.envs.setup import Setup
from codrl_mj.envs.snapshots import check_snapshot
from codrl_mj.motor import Actuator
from codrl_mj.physics import MujocoPhysics
from codrl_mj.physics.offscreen import OffscreenRenderer, check_view
from codrl_mj.physics.streams import set_words, words_of
from codrl_mj.tasks import Task


class ActuatedEnv(gymnasium.Env[np.ndarray, Any]):
    """A classic-control task whose actions go through an actuator.

    Observation, action, reward, start and end are Gymnasium's for the task; what differs is the force: the action
    chooses the desired one, the actuator delivers the actual one. With `actuator="ideal"` they are equal and the
    environment is a drop-in for Gymnasium's.

    Every step's `info` has `desired_force`, `actual_force` [N or N*m], `current`, `reference_current` [A], `voltage`
    [V] and `saturated` (bool), each at the end of the step. Currents and voltage are 0 where the actuator is ideal;
    where the agent commands the voltage, what is delivered is what is desired.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 50}  # noqa: RUF012 - as Gymnasium has it

    def __init__(
        self,
        task: str,
        actuator: str | Actuator | Mapping[str, Any] | None = "paper",
        physics: str = "mujoco",
        integrator: str | None = None,
        inner_steps: int | None = None,
        timestep: float | None = None,
        allow_unstable: bool = False,
        action: str = "force",
        levels: Sequence[float] | None = None,
        observe_actuator: bool = False,
        randomize: Mapping[str, Distribution] | None = None,
        disturbances: Disturbances | Mapping[str, Any] | None = None,
        render_mode: str | None = None,
        width: int = 480,
        height: int = 480,
        camera: str = "fixed",
        pretty: bool = False,
        **options: float,
    ) -> None:
        """Build the environment.

        Args:
            task: the task's name, such as `cartpole`.
            actuator: a name (`ideal`, `paper`, `weak`, `weaker`, `open_loop`), an `Actuator`, or a mapping of its
                fields.
            physics: `mujoco`, or `analytic` (Gymnasium's own equations).
            integrator: one of the task's integrators; the default is Gymnasium's.
            inner_steps: integration steps per environment step; the default is the paper's inner loop with a motor and
                one without.
            timestep: instead of `inner_steps`, the integration step [s], which must divide the environment step.
            allow_unstable: build the environment even if the current loop is unstable.
            action: what the agent commands: the desired `force` (the paper), the reference `current` [A], or the raw
                terminal `voltage` [V] past the controller (end to end).
            levels: for discrete tasks with `action="current"` or `"voltage"`: the commands that actions choose from.
            observe_actuator: append measured and reference current [A] to the observation.
            randomize: what to draw at every reset, after the initial state: names of fields of the actuator
                (`motor.inductance`, `controller.kp`) and the model (`model.mass.BODY`, `model.length.BODY`,
                `model.gravity`, `model.damping.JOINT`), each with a `Uniform`, `LogUniform` or `Choice`. What was drawn
                is in the reset's `info["randomization"]`.
            disturbances: a `Disturbances`, or a mapping of its fields: delayed, coarse and slow commands, a noisy and
                biased current sensor, a sagging supply, load pulses, joint friction and damping. With
                `observe_actuator` the agent sees the sensor's current.
            render_mode: None or `rgb_array`.
            width: width of rendered images [px].
            height: height of rendered images [px].
            camera: a camera of the model: `fixed` or `close`.
            pretty: shadows, reflections and multisampling.
            **options: the task's own options (CartPole: `center_radius`).

        Raises:
            ValueError: an argument is unknown or out of bounds, or the current loop is unstable; the message names it.
            CallbackInUseError: another library's MuJoCo callback is installed.
        """
        self.setup = Setup.build(
            task,
            actuator,
            integrator=integrator,
            inner_steps=inner_steps,
            timestep=timestep,
            allow_unstable=allow_unstable,
            action=action,
            levels=levels,
            observe_actuator=observe_actuator,
            randomize=randomize,
            disturbances=disturbances,
            **options,
        )
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"render_mode = {render_mode!r}: must be None or 'rgb_array'")
        self.physics = self.setup.simulate(physics)
        self._actuator = self.setup.actuator
        self._randomization: dict[str, Any] = {}
        self.render_mode = render_mode
        self.metadata = {**self.metadata, "render_fps": self.setup.task.render_fps}
        self._view = {"width": width, "height": height, "camera": camera, "pretty": pretty}
        self._renderer: OffscreenRenderer | None = None
        self._drawn: MujocoPhysics | None = None
        if render_mode is not None:
            check_view(self._scene().model, width, height, camera)
        self.action_space = self.setup.action_space
        self.observation_space = self.setup.observation_space
        self._observation_shape = self.observation_space.shape
        self._compiled: tuple[Any, tuple[Any, ...]] | None = (
            None  # its step, and the arguments that are this simulation
        )

    @property
    def task(self) -> Task:
        """The task."""
        return self.setup.task

    @property
    def actuator(self) -> Actuator | None:
        """The actuator, of the present episode where it is drawn; None is the ideal one."""
        return self._actuator

    @property
    def model(self) -> Any:
        """The `mujoco.MjModel` (MuJoCo physics only); one `mj_step` of it is one integration step."""
        return self._mujoco_physics().model

    @property
    def data(self) -> Any:
        """The `mujoco.MjData` (MuJoCo physics only)."""
        return self._mujoco_physics().data

    @property
    def state(self) -> np.ndarray:
        """The mechanical state, shape (n,), float64, in Gymnasium's order."""
        return self.physics.state.copy()

    def _mujoco_physics(self) -> MujocoPhysics:
        if not isinstance(self.physics, MujocoPhysics):
            raise AttributeError("physics='analytic' has no MuJoCo model or data; use physics='mujoco'")
        return self.physics

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode; the motor is at rest.

        Args:
            seed: seed of the initial state; the same seed draws the state that Gymnasium's environment draws.
            options: Gymnasium's reset options for the task (CartPole: the bounds `low` and `high`).
        """
        super().reset(seed=seed)
        self._actuator, info = self.setup.start(self.physics, self.np_random, options)
        self._randomization = info.get("randomization", {})
        return self.setup.observation(self.physics.state, self.setup.seen(self.physics, None)), info

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Advance by one environment step.

        Args:
            action: an element of the action space; a continuous one may lie outside its bounds, where the desired
                force saturates.

        Raises:
            ValueError: the action is not in the action space, or not a number.
            SimulationDivergedError: the simulation left the finite numbers.
        """
        force = self.setup.force(action)
        if self._compiled is None:
            if not isinstance(self.physics, MujocoPhysics):
                return self._step_apart(force)
            self._compiled = compiled_kernels(self.setup, self.physics).step, arguments(self.setup, self.physics)
        step, simulation = self._compiled
        observation = np.empty(self._observation_shape, np.float32)
        reward, terminated, fine, desired, actual, current, reference, voltage, saturated = step(
            force, observation, *simulation
        )
        if not fine:
            self._mujoco_physics().check_finite()
        info = {
            "desired_force": desired,
            "actual_force": actual,
            "current": current,
            "reference_current": reference,
            "voltage": voltage,
            "saturated": saturated,
        }
        return observation, reward, terminated, False, info

    def _step_apart(self, force: float) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """What the compiled step does, in parts, for a physics that is Python."""
        setup, physics = self.setup, self.physics
        before = physics.state
        delivered = physics.step(force)
        signals = setup.signals(delivered)
        seen = setup.seen(physics, delivered) if setup.senses else signals
        after = physics.state
        observation, reward = setup.observation(after, seen), setup.reward(before, signals, after)
        return observation, reward, setup.terminated(after), False, signals._asdict()

    @property
    def randomization(self) -> dict[str, Any]:
        """What the present episode was drawn with, as in the reset's info; empty if nothing was drawn."""
        return dict(self._randomization)

    def snapshot(self) -> dict[str, np.ndarray]:
        """Everything that the future depends on, as plain arrays: simulation, motor, generator, what was drawn.

        The generators of the spaces, and what wrappers count, are theirs.
        """
        everything = {
            "task": np.frombuffer(self.task.name.encode(), dtype=np.uint8).copy(),
            "physics": self.physics.snapshot(),
            "generator": words_of(self.np_random),
        }
        if self.physics.memory.size:
            everything["disturbances"] = self.physics.memory.copy()
        if self.setup.randomization is not None:
            drawn = [self._randomization.get(name, np.nan) for name in self.setup.randomization.names]
            everything["drawn"] = np.array(drawn, dtype=np.float64)
            everything["rejected"] = np.array(self._randomization.get("rejected", 0))
        return everything

    def restore(self, snapshot: Mapping[str, np.ndarray]) -> None:
        """Continue from what `snapshot` returned, bit for bit, in an environment made with the same arguments.

        Raises:
            ValueError: the snapshot is of another task, or of arguments that need other entries or shapes; nothing was
                changed.
        """
        expected = self.snapshot()
        check_snapshot(snapshot, expected)
        if not np.array_equal(snapshot["task"], expected["task"]):
            raise ValueError(f"snapshot['task'] is of {bytes(snapshot['task'])!r}: must be of {self.task.name!r}")
        randomization = self.setup.randomization
        if randomization is not None:
            values, drawn = snapshot["drawn"], not np.isnan(snapshot["drawn"]).any()
            self._randomization = randomization.report(values, int(snapshot["rejected"])) if drawn else {}
            self._actuator = self.setup.vary(
                self.physics, values if drawn else randomization.nominal_values(self.setup.actuator)
            )
        self.physics.restore(snapshot["physics"])
        self.physics.memory[:] = snapshot.get("disturbances", 0.0)
        generator, _ = seeding.np_random(0)
        set_words(generator, snapshot["generator"])
        self.np_random = generator

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """The present state as an image, shape (height, width, 3), uint8; None if there is no render mode.

        Raises:
            RenderingUnavailableError: no OpenGL context can be made here; the message has the remedy.
        """
        if self.render_mode is None:
            gymnasium.logger.warn("render() without a render mode: pass render_mode='rgb_array' when making it")
            return None
        scene = self._scene()
        if self._renderer is None:
            self._renderer = OffscreenRenderer(scene.model, **self._view)  # type: ignore[arg-type]
        scene.show(self.physics.state)
        return self._renderer.render(scene.data)

    def _scene(self) -> MujocoPhysics:
        """What is drawn: the simulation itself, or the task's ideal model where the physics is analytic."""
        if isinstance(self.physics, MujocoPhysics):
            return self.physics
        if self._drawn is None:
            self._drawn = MujocoPhysics(self.task, None, 1, self.setup.integrator)
        return self._drawn

    def close(self) -> None:
        """Free the OpenGL context."""
        if self._renderer is not None:
            self._renderer.close()
        self._renderer = self._drawn = None

    def __getstate__(self) -> dict[str, Any]:
        """Everything but the renderer and the compiled step, which a copy makes anew."""
        return self.__dict__ | {"_renderer": None, "_drawn": None, "_compiled": None}
