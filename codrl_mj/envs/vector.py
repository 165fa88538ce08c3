"""A Gymnasium `VectorEnv` of thousands of environments that compiled code steps together."""

from collections.abc import Mapping, Sequence

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from codrl_mj.boundary import Argument, AttributeValue, Info, Options, PickledState
from codrl_mj.envs.attributes import GymnasiumAttributes, is_shared, read, validate_states, write
from codrl_mj.envs.compiled import Kernels, VectorStep, compiled_kernels
from codrl_mj.envs.config import EnvConfig
from codrl_mj.envs.setup import set_up_many, task_config
from codrl_mj.envs.snapshots import check_snapshot
from codrl_mj.envs.task_bank import TaskBank
from codrl_mj.fields import free_memory
from codrl_mj.physics import Signals
from codrl_mj.physics.mujoco_batch import MujocoBatchPhysics
from codrl_mj.physics.offscreen import OffscreenRenderer, check_view
from codrl_mj.physics.streams import Streams
from codrl_mj.physics.variation import DYNAMIC_FIELDS, VISUAL_FIELDS, field_of, write_fields
from codrl_mj.tasks import Task

Array = np.ndarray


class ActuatedVectorEnv(GymnasiumAttributes, VectorEnv[Array, Array, Array]):
    """N environments that step together, each bit for bit like an `ActuatedEnv` with a time limit.

    `gymnasium.make_vec(id, num_envs=N, vectorization_mode="vector_entry_point")` makes one. No
    Python code runs per environment: states, motors, generators and bookkeeping are arrays.

    Infos are arrays of shape (N,) with Gymnasium's masks (`_current` is True in rows that have a
    `current`). After a step in `SAME_STEP` mode, `final_obs` and `final_info` hold the last
    observations and infos of the episodes that ended.
    """

    # Class attribute, as in Gymnasium; an instance replaces it and never changes it.
    metadata: Info = {  # noqa: RUF012
        "render_modes": ["rgb_array", "rgb_array_list"],
        "render_fps": 50,
    }

    def __init__(
        self,
        num_envs: int,
        task: str | EnvConfig,
        actuator: object = None,
        max_episode_steps: int | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        num_threads: int = 0,
        render_mode: str | None = None,
        width: int = 480,
        height: int = 480,
        camera: str = "fixed",
        pretty: bool = False,
        **arguments: Argument,
    ) -> None:
        """Build the environments.

        Args:
            num_envs: number of environments, >= 1.
            task: the task's name, or a configuration, whose time limit does not count.
            actuator: as for `ActuatedEnv`; or a sequence of N actuators (tuples of them for several
                motors), one for each environment: all of one family, and not ideal.
            max_episode_steps: time limit of each environment [steps]; None for none.
            autoreset_mode: reset of an environment after its episode: in the next step
                (`NEXT_STEP`), in the same step (`SAME_STEP`), or by the caller (`DISABLED`), who
                calls `reset(options={"reset_mask": ...})`.
            num_threads: threads of the engine; 0 uses every CPU. Results do not depend on it.
            render_mode: None; or `rgb_array`: `render` returns an image of every environment,
                `image` that of one; or `rgb_array_list`, the same under the name that Gymnasium's
                vector wrappers expect.
            width: width of rendered images [px].
            height: height of rendered images [px].
            camera: a camera of the model.
            pretty: True to render shadows, reflections and multisampling.
            **arguments: the other arguments of `ActuatedEnv`.

        Raises:
            ValueError: an argument is unknown or out of bounds, or a current loop is unstable; the
                message names it.
            CallbackInUseError: another library's MuJoCo callback is installed.
        """
        check_counts(num_envs, max_episode_steps)
        if (
            isinstance(num_threads, bool)
            or not isinstance(num_threads, int | np.integer)
            or num_threads < 0
        ):
            raise ValueError(
                f"num_threads = {num_threads!r}: must be an integer >= 0 (0: every CPU)"
            )
        if render_mode not in (None, *self.metadata["render_modes"]):
            modes = ", ".join(self.metadata["render_modes"])
            raise ValueError(f"render_mode = {render_mode!r}: must be one of None, {modes}")
        self.num_envs = int(num_envs)
        # A list has one actuator for each environment; it is no value of `EnvConfig.actuator`.
        config = task_config(task, None, arguments)
        if config.physics != "mujoco":
            raise ValueError(
                f"physics = {config.physics!r}: a vector environment needs 'mujoco'; the analytic"
                " physics steps one Gymnasium environment at a time: use vectorization_mode='sync'"
            )
        self.setup, actuators = set_up_many(config, self.num_envs, actuator)
        self.physics = MujocoBatchPhysics(self.setup.simulation, actuators, int(num_threads))
        self.bank = TaskBank(self.setup, self.physics, actuators)
        """The actuators of all environments: their commands, draws, sensors and signals."""
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {
            **self.metadata,
            "render_fps": self.setup.task.render_fps,
            "autoreset_mode": self.autoreset_mode,
        }
        self.render_mode = render_mode
        self.max_episode_steps = max_episode_steps
        self.single_action_space = self.bank.action_space
        self.single_observation_space = self.setup.observation_space
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.arm_radii = np.array([motor.arm_radius for motor in self.setup.config.actuators])
        """Arms of the motors of an environment [m], shape (motors,)."""
        self._streams = Streams(self.num_envs)
        self._elapsed = np.zeros(self.num_envs, dtype=np.int64)
        self._ended = np.zeros(self.num_envs, dtype=bool)
        self._observations: Array = np.zeros(self.observation_space.shape or (), dtype=np.float32)
        # Signals of the last step, each an array of shape (N,) or (N, motors).
        self.signals: Signals | None = None
        self._view = {"width": width, "height": height, "camera": camera, "pretty": pretty}
        if render_mode is not None:
            check_view(self.physics.model, width, height, camera)
        self._renderer: OffscreenRenderer | None = None
        self._kernels: tuple[Kernels, VectorStep] | None = None
        # Model fields of each environment, after attributes were written; rendering uses them.
        self.model_fields: dict[str, Array] = {}
        self._offer_attributes(self.task)

    @property
    def task(self) -> Task:
        """The task."""
        return self.setup.task

    @property
    def state(self) -> Array:
        """Mechanical states, (N, n), float64, as in Gymnasium; setting keeps the motors' states."""
        return self.physics.state

    @state.setter
    def state(self, states: object) -> None:
        self.physics.state = validate_states(states, self.physics.state.shape)

    def get_attr(self, name: str) -> tuple[AttributeValue, ...]:
        """Return an attribute for each environment, as Gymnasium's `SyncVectorEnv` does."""
        value = getattr(self, name)
        is_array_of_envs = isinstance(value, np.ndarray) and value.shape[:1] == (self.num_envs,)
        return (
            tuple(value.tolist() if value.ndim == 1 else value)
            if is_array_of_envs
            else (value,) * self.num_envs
        )

    def set_attr(self, name: str, values: Options) -> None:
        """Set an attribute of all environments; a list or tuple has one value for each."""
        setattr(self, name, np.array(values) if isinstance(values, list | tuple) else values)

    def call(self, name: str, *args: Argument, **kwargs: Argument) -> tuple[AttributeValue, ...]:
        """Return an attribute for each environment; call a method once for all of them."""
        value = getattr(self, name)
        return (value(*args, **kwargs),) * self.num_envs if callable(value) else self.get_attr(name)

    def _read_attribute(self, name: str) -> AttributeValue:
        """Return one value if the environments share it, otherwise an array (N,)."""
        if is_shared(self.task.attributes[name]):
            return read(name, self.setup, self.physics.model)
        return np.array([read(name, self.setup, model) for model in self.physics.models()])

    def _write_attribute(self, name: str, value: AttributeValue) -> None:
        """Write one value for all environments, or an array (N,) with one for each."""
        if is_shared(self.task.attributes[name]):
            if not np.array_equal(value, present := self._read_attribute(name)):
                raise AttributeError(
                    f"{name} = {value!r}: the environments share the value {present!r}; use"
                    " vectorization_mode='sync'"
                )
            return
        if np.shape(value) not in ((), (self.num_envs,)):
            raise ValueError(
                f"{name} = {value!r}: must be one number, or {self.num_envs}, one for each"
                " environment"
            )
        fields = {field: self.physics.field(field).copy() for field in DYNAMIC_FIELDS}
        visual_fields = {
            field: np.array([field_of(self.physics.model, field)] * self.num_envs)
            for field in VISUAL_FIELDS
        }
        visual_fields |= {
            field: rows.copy()
            for field, rows in self.model_fields.items()
            if field in VISUAL_FIELDS
        }
        values = np.broadcast_to(value, self.num_envs).tolist()
        for row, (model, env_value) in enumerate(zip(self.physics.models(), values, strict=True)):
            write_fields(model, visual_fields, row)
            write(name, env_value, self.setup, model)
            for field, rows in (fields | visual_fields).items():
                rows[row] = field_of(model, field)
        # A reset or restore must follow `set_model`; restoring keeps the states.
        snapshot = self.physics.snapshot()
        self.physics.set_model(np.arange(self.num_envs), fields)
        self.physics.restore(snapshot)
        self.model_fields = fields | visual_fields

    @property
    def randomization(self) -> dict[str, Array]:
        """Drawn values of the present episodes, path -> array (N,), and the number `rejected`."""
        return self.bank.randomization.drawn_values()

    @property  # type: ignore[misc]
    def np_random(self) -> tuple[np.random.Generator, ...]:  # type: ignore[override]
        """Generators of the environments."""
        return tuple(self._streams.generators)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: Info | None = None,
    ) -> tuple[Array, Info]:
        """Start episodes in all environments, or in those of `options["reset_mask"]`.

        Args:
            seed: seed of the first environment, from which those of the others count up; or a
                sequence of seeds, in which None leaves a generator as it is.
            options: Gymnasium's reset options for the task, and `reset_mask`: shape (N,), bool,
                with at least one True.

        Raises:
            ValueError: wrong number of seeds, or wrong shape or type of the mask.
        """
        options = dict(options or {})
        mask = options.pop("reset_mask", np.ones(self.num_envs, dtype=bool))
        if (
            not isinstance(mask, np.ndarray)
            or mask.shape != (self.num_envs,)
            or mask.dtype != bool
            or not mask.any()
        ):
            raise ValueError(
                f"reset_mask = {mask!r}: must be a bool array of shape ({self.num_envs},) with at"
                " least one True"
            )
        seeds: Sequence[int | None]
        if seed is None or isinstance(seed, int | np.integer):
            seeds = [None if seed is None else int(seed) + index for index in range(self.num_envs)]
        else:
            seeds = seed
        if len(seeds) != self.num_envs:
            raise ValueError(
                f"seed: got {len(seeds)} seeds for {self.num_envs} environments; give one for each"
                " environment"
            )
        rows = np.flatnonzero(mask)
        chosen_seeds = [seeds[row] for row in rows.tolist()]
        if any(env_seed is not None for env_seed in chosen_seeds):
            self._streams.seed(rows, chosen_seeds)
        infos = self._restart(rows, options or None)
        return self._observations.copy(), infos

    def _restart(self, rows: Array, options: Info | None) -> Info:
        """Start episodes in some environments, and write `_observations`.

        Returns:
            Infos of the reset, with the drawn values.
        """
        low, high = self.setup.task.bounds(options) if options else self.setup.initial_bounds
        draws = low + (high - low) * self._streams.random(rows, len(low))
        states = self.setup.task.initial_states(draws)
        self.bank.randomization.draw(self._streams.random, rows)
        keys = self.bank.keys(lambda count: self._streams.random(rows, count))
        self.physics.reset(rows, states, keys)
        self.physics.observe(self._compiled()[0].observe_rows, rows, self._observations)
        self._elapsed[rows] = 0
        self._ended[rows] = False
        return self.bank.randomization.infos(rows)

    def step(self, actions: Array) -> tuple[Array, Array, Array, Array, Info]:
        """Advance every environment by one step.

        Args:
            actions: shape (N, ...).

        Returns:
            Observations (N, k) float32, rewards (N,) float64, terminations and truncations (N,)
            bool, infos.

        Raises:
            ValueError: actions of wrong shape or type, or one that is not in the action space; the
                message names the environment, and none was stepped.
            SimulationDivergedError: a value of a simulation is not finite; the message names the
                environment. All were stepped, and can continue after a reset of this one by
                `reset(options={"reset_mask": ...})`.
            RuntimeError: in `DISABLED` mode, an environment whose episode ended was not reset.
        """
        forces = self.bank.forces(actions)
        if len(forces) != self.num_envs:
            raise ValueError(
                f"actions: got {len(forces)} rows for {self.num_envs} environments; give one for"
                " each environment"
            )
        if self.autoreset_mode == AutoresetMode.DISABLED and self._ended.any():
            row = int(np.argmax(self._ended))
            raise RuntimeError(
                f"environment {row} has ended and was not reset: "
                "call reset(options={'reset_mask': terminated | truncated})"
            )
        # In NEXT_STEP mode, environments whose episode ended are reset instead of stepped.
        stepping = ~self._ended
        kernels, steps = self._compiled()
        steps.forces[:], steps.stepping[:] = forces, stepping
        steps.limit[0] = np.inf if self.max_episode_steps is None else self.max_episode_steps
        has_diverged = self.physics.step(kernels.step_rows, steps)
        rewards, terminated, truncated = (
            steps.rewards.copy(),
            steps.terminated.copy(),
            steps.truncated.copy(),
        )
        columns = steps.signals.reshape(-1, *forces.shape).copy()
        self.signals = signals = self.bank.signals([forces, *columns], forces)
        if has_diverged:
            # `check_finite` raises. Record which episodes ended first, because they must still be
            # reset.
            self._ended |= terminated | truncated
            self.physics.check_finite(self.physics.state, stepping)
        infos = _vector_infos(signals, stepping)
        if not stepping.all():
            infos |= self._restart(np.flatnonzero(~stepping), None)
        self._ended = terminated | truncated
        if self.autoreset_mode == AutoresetMode.SAME_STEP and self._ended.any():
            infos = self._reset_ended(infos)
        return self._observations.copy(), rewards, terminated, truncated, infos

    def _compiled(self) -> tuple[Kernels, VectorStep]:
        """Return the compiled functions, and the inputs and outputs of their step."""
        if self._kernels is None:
            num_envs, motors = self.num_envs, len(self.task.motors)
            columns = 1 + len(self.setup.simulation.family.Signals._fields)
            steps = VectorStep(
                np.empty(num_envs if motors == 1 else (num_envs, motors)),
                np.empty(num_envs, dtype=bool),
                self._observations,
                np.empty(num_envs),
                np.empty(num_envs, dtype=bool),
                np.empty(num_envs, dtype=bool),
                self._elapsed,
                np.empty(1),
                self.setup.options,
                np.empty((columns, num_envs, motors)),
            )
            self._kernels = compiled_kernels(self.setup, self.physics), steps
        return self._kernels

    def _reset_ended(self, infos: Info) -> Info:
        """Reset environments whose episode ended; put their last data into the infos."""
        ended, rows = self._ended.copy(), np.flatnonzero(self._ended)
        final_obs = np.full(self.num_envs, None, dtype=object)
        for row, observation in zip(rows.tolist(), self._observations[rows], strict=True):
            final_obs[row] = observation
        final_info: Info = {}
        remaining: Info = {}
        for name in [name for name in infos if not name.startswith("_")]:
            final_info[name], final_info[f"_{name}"] = np.zeros_like(infos[name]), ended.copy()
            final_info[name][rows] = infos[name][rows]
            if len(rows) < self.num_envs:
                remaining[name], remaining[f"_{name}"] = infos[name].copy(), ~ended
                remaining[name][rows] = 0
        reset_infos = self._restart(rows, None)
        return {
            "final_obs": final_obs,
            "_final_obs": ended.copy(),
            "final_info": final_info,
            "_final_info": ended.copy(),
            **remaining,
            **reset_infos,
        }

    def snapshot(self) -> dict[str, Array]:
        """Return the complete state as arrays: simulations, motors, generators, bookkeeping."""
        return {
            "physics": self.physics.snapshot(),
            "streams": self._streams.state(),
            "elapsed": self._elapsed.copy(),
            "ended": self._ended.copy(),
            "observations": self._observations.copy(),
            **self.bank.snapshot(),
        }

    def restore(self, snapshot: Mapping[str, Array]) -> None:
        """Continue from a snapshot, bit for bit.

        Raises:
            ValueError: the snapshot is of another number of environments, or of another task.
        """
        check_snapshot(snapshot, self.snapshot())
        self.bank.restore(snapshot)
        self.physics.restore(snapshot["physics"])
        self._streams.set_state(snapshot["streams"])
        self._elapsed[:], self._ended[:] = snapshot["elapsed"], snapshot["ended"]
        self._observations[:] = snapshot["observations"]
        # The last step's signals are not part of a snapshot.
        self.signals = None

    def __getstate__(self) -> PickledState:
        """Return all but the renderer and the compiled step; a copy makes new ones."""
        return self.__dict__ | {"_renderer": None, "_kernels": None}

    def render(self) -> tuple[Array, ...] | None:
        """Return images (height, width, 3), uint8, of all environments; None if not rendered."""
        images = [self.image(row) for row in range(self.num_envs if self.render_mode else 1)]
        return None if images[0] is None else tuple(images)  # type: ignore[arg-type]

    def image(self, row: int = 0) -> Array | None:
        """Return an image (height, width, 3), uint8, of one environment; None if not rendered."""
        if self.render_mode is None:
            gymnasium.logger.warn(
                "render() without a render mode: pass render_mode='rgb_array' when making it"
            )
            return None
        if self._renderer is None:
            self._renderer = OffscreenRenderer(self.physics.model, **self._view)  # type: ignore[arg-type]
        write_fields(
            self.physics.model, self.bank.randomization.model_fields(np.array([row]), shown=True)
        )
        write_fields(self.physics.model, self.model_fields, row)
        self.physics.show(row)
        return self._renderer.render(self.physics.data)

    def close_extras(self, **kwargs: Argument) -> None:
        """Free the OpenGL context."""
        del kwargs
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None


def check_counts(num_envs: int, max_episode_steps: int | None, bytes_per_env: int = 3_000) -> None:
    """Raise if the numbers of environments or steps are invalid, or the memory is too small.

    Args:
        num_envs: number of environments.
        max_episode_steps: time limit [steps], or None.
        bytes_per_env: memory that an environment takes [bytes].
    """
    counts_of_steps = {} if max_episode_steps is None else {"max_episode_steps": max_episode_steps}
    for name, count in {"num_envs": num_envs, **counts_of_steps}.items():
        if isinstance(count, bool) or not isinstance(count, int | np.integer) or count < 1:
            raise ValueError(f"{name} = {count!r}: must be an integer >= 1")
    if (free_bytes := free_memory()) is not None and num_envs * bytes_per_env > free_bytes:
        raise ValueError(
            f"num_envs = {num_envs}: takes about {num_envs * bytes_per_env / 1e9:.3g} GB of memory,"
            f" but {free_bytes / 1e9:.3g} GB are free: must be <= {free_bytes // bytes_per_env}"
        )


def _vector_infos(signals: Signals, stepping: Array) -> Info:
    """Return the signals as Gymnasium's vector infos: 0 and masked where no step was taken."""
    if not stepping.any():
        return {}
    reset_rows = np.flatnonzero(~stepping)
    infos: Info = {}
    for name, values in signals.items():
        infos[name] = values
        if len(reset_rows):
            infos[name] = values.copy()
            infos[name][reset_rows] = 0
        infos[f"_{name}"] = stepping.copy()
    return infos
