"""Thousands of environments as one, stepped together by compiled code: Gymnasium's `VectorEnv`."""

import functools
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from codrl_mj.envs.attributes import GymnasiumAttributes, checked_states, read, shared, written
from codrl_mj.envs.compiled import Kernels, VectorStep, compiled_kernels
from codrl_mj.envs.randomization import RandomizationState, apply_to_batch
from codrl_mj.envs.setup import set_up_many
from codrl_mj.envs.snapshots import check_snapshot
from codrl_mj.fields import free_memory
from codrl_mj.physics import Signals
from codrl_mj.physics.mujoco_batch import MujocoBatchPhysics
from codrl_mj.physics.offscreen import OffscreenRenderer, check_view
from codrl_mj.physics.streams import Streams
from codrl_mj.physics.variation import VISUAL_FIELDS, DYNAMIC_FIELDS, field_of, write_fields
from codrl_mj.tasks import Task

Array = np.ndarray


class ActuatedVectorEnv(GymnasiumAttributes, VectorEnv[Array, Array, Array]):
    """N environments that step together, each bit for bit an `ActuatedEnv` with a time limit.

    Made by `gymnasium.make_vec(id, num_envs=N, vectorization_mode="vector_entry_point")`. No Python
    runs for a single environment: states, motors, generators and bookkeeping are arrays.

    Infos are arrays of shape (N,) with Gymnasium's masks (`_current` says which rows have a
    `current`). After a step in `SAME_STEP` mode, `final_obs` and `final_info` hold what the
    episodes that ended saw last.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 - as Gymnasium has it
        "render_modes": ["rgb_array", "rgb_array_list"],
        "render_fps": 50,
    }

    def __init__(
        self,
        num_envs: int,
        task: str,
        actuator: Any = "default",
        max_episode_steps: int | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        num_threads: int = 0,
        physics: str = "mujoco",
        render_mode: str | None = None,
        width: int = 480,
        height: int = 480,
        camera: str = "fixed",
        pretty: bool = False,
        **arguments: Any,
    ) -> None:
        """Build the environments.

        Args:
            num_envs: how many, >= 1.
            task: the task's name.
            actuator: as for `ActuatedEnv`; or a sequence of N of these (with several motors, of
                tuples of them), one for each environment: all of one family, and not ideal.
            max_episode_steps: time limit of each environment [steps]; None for none.
            autoreset_mode: when an environment whose episode ended is reset: in the `NEXT_STEP`, in
                the `SAME_STEP`, or by the caller (`DISABLED`), with `reset(options={"reset_mask":
                ...})`.
            num_threads: threads of the engine; 0 uses every CPU. Results do not depend on it.
            physics: `mujoco`; the analytic physics steps one Gymnasium environment at a time and
                cannot be batched.
            render_mode: None or `rgb_array`: `render` then draws every environment, `image` one of
                them. So it does in `rgb_array_list`, as Gymnasium's vector wrappers expect.
            width: width of rendered images [px].
            height: height of rendered images [px].
            camera: a camera of the model.
            pretty: shadows, reflections and multisampling.
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
        if physics != "mujoco":
            raise ValueError(
                f"physics = {physics!r}: a vector environment needs 'mujoco'; the analytic physics"
                " steps one Gymnasium environment at a time: use vectorization_mode='sync' for it"
            )
        if render_mode not in (None, *self.metadata["render_modes"]):
            modes = ", ".join(self.metadata["render_modes"])
            raise ValueError(f"render_mode = {render_mode!r}: must be one of None, {modes}")
        self.num_envs = int(num_envs)
        self.setup, actuators = set_up_many(self.num_envs, task, actuator, arguments)
        self.physics = MujocoBatchPhysics(self.setup.plant, actuators, int(num_threads))
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {
            **self.metadata,
            "render_fps": self.setup.task.render_fps,
            "autoreset_mode": self.autoreset_mode,
        }
        self.render_mode = render_mode
        self.max_episode_steps = max_episode_steps
        self.single_action_space = self.setup.commands.action_space
        self.single_observation_space = self.setup.observation_space
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.arm_radii = np.array([one.arm_radius for one in self.setup.config.actuators])
        """Of the motors of an environment [m], shape (motors,)."""
        self._streams = Streams(self.num_envs)
        self._draws = RandomizationState(
            self.setup.randomization, actuators, functools.partial(apply_to_batch, self.physics)
        )
        self._elapsed = np.zeros(self.num_envs, dtype=np.int64)
        self._ended = np.zeros(self.num_envs, dtype=bool)
        self._observations: Array = np.zeros(self.observation_space.shape or (), dtype=np.float32)
        self.signals: Signals | None = None  # of the last step, each an array of shape (N,)
        self._view = {"width": width, "height": height, "camera": camera, "pretty": pretty}
        if render_mode is not None:
            check_view(self.physics.model, width, height, camera)
        self._renderer: OffscreenRenderer | None = None
        self._kernels: tuple[Kernels, VectorStep] | None = None
        self.looks: dict[str, Array] = {}  # fields of the models, where attributes were written
        self._offer_attributes(self.task)

    @property
    def task(self) -> Task:
        """The task."""
        return self.setup.task

    @property
    def state(self) -> Array:
        """Mechanical states, shape (N, n), float64, in Gymnasium's order; set, it moves there, motors as they are."""
        return self.physics.state

    @state.setter
    def state(self, states: Any) -> None:
        self.physics.state = checked_states(states, self.physics.state.shape)

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """An attribute, once for each environment, as Gymnasium's `SyncVectorEnv` has it."""
        value = getattr(self, name)
        each = isinstance(value, np.ndarray) and value.shape[:1] == (self.num_envs,)
        return (
            tuple(value.tolist() if value.ndim == 1 else value)
            if each
            else (value,) * self.num_envs
        )

    def set_attr(self, name: str, values: Any) -> None:
        """Set an attribute of all environments: a list or tuple has a value for each of them."""
        setattr(self, name, np.array(values) if isinstance(values, list | tuple) else values)

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """An attribute once for each environment; or a method, which is called once for all of them."""
        value = getattr(self, name)
        return (value(*args, **kwargs),) * self.num_envs if callable(value) else self.get_attr(name)

    def _read_attribute(self, name: str) -> Any:
        """One value where the environments share it, else shape (N,)."""
        if shared(self.task.attributes[name]):
            return read(name, self.setup, self.physics.model)
        return np.array([read(name, self.setup, model) for model in self.physics.models()])

    def _write_attribute(self, name: str, value: Any) -> None:
        if shared(self.task.attributes[name]):
            if not np.array_equal(value, present := self._read_attribute(name)):
                raise AttributeError(
                    f"{name} = {value!r}: the environments share it, as {present!r}; use"
                    " vectorization_mode='sync'"
                )
            return
        if np.shape(value) not in ((), (self.num_envs,)):
            raise ValueError(
                f"{name} = {value!r}: must be one number, or {self.num_envs}, one for each"
                " environment"
            )
        fields = {field: self.physics.field(field).copy() for field in DYNAMIC_FIELDS}
        looks = {
            field: np.array([field_of(self.physics.model, field)] * self.num_envs)
            for field in VISUAL_FIELDS
        }
        looks |= {field: rows.copy() for field, rows in self.looks.items() if field in VISUAL_FIELDS}
        numbers = np.broadcast_to(value, self.num_envs).tolist()
        for row, (model, number) in enumerate(zip(self.physics.models(), numbers, strict=True)):
            write_fields(model, looks, row)
            written(name, number, self.setup, model)
            for field, rows in (fields | looks).items():
                rows[row] = field_of(model, field)
        kept = self.physics.snapshot()
        self.physics.set_model(np.arange(self.num_envs), fields)
        self.physics.restore(kept)
        self.looks = fields | looks

    @property
    def randomization(self) -> dict[str, Array]:
        """What the present episodes were drawn with: shape (N,) for every field, and how many sets were `rejected`."""
        return self._draws.present()

    @property  # type: ignore[misc]
    def np_random(self) -> tuple[np.random.Generator, ...]:  # type: ignore[override]
        """The environments' generators."""
        return tuple(self._streams.generators)

    def reset(  # type: ignore[override]
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Array, dict[str, Any]]:
        """Start episodes, in every environment or in those of `options["reset_mask"]`.

        Args:
            seed: of the first environment, the others counting up from it; or one for each (None
                leaves a generator).
            options: Gymnasium's reset options for the task, and `reset_mask`: shape (N,), bool,
                with a True in it.

        Raises:
            ValueError: wrong number of seeds, or a mask of wrong shape or type.
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
                f"reset_mask = {mask!r}: must be a bool array of shape ({self.num_envs},) with a"
                " True in it"
            )
        seeds: Sequence[int | None]
        if seed is None or isinstance(seed, int | np.integer):
            seeds = [None if seed is None else int(seed) + index for index in range(self.num_envs)]
        else:
            seeds = seed
        if len(seeds) != self.num_envs:
            raise ValueError(
                f"seed: {len(seeds)} seeds for {self.num_envs} environments: there must be one for"
                " each"
            )
        rows = np.flatnonzero(mask)
        chosen = [seeds[row] for row in rows.tolist()]
        if any(one is not None for one in chosen):
            self._streams.seed(rows, chosen)
        infos = self._restart(rows, options or None)
        return self._observations.copy(), infos

    def _restart(self, rows: Array, options: dict[str, Any] | None) -> dict[str, Any]:
        """Start episodes in some environments; their observations are in `_observations` then.

        Returns:
            The infos of the reset: what was drawn.
        """
        low, high = self.setup.task.bounds(options) if options else self.setup.initial_bounds
        draws = low + (high - low) * self._streams.random(rows, len(low))
        states = self.setup.task.initial_states(draws)
        self._draws.draw(self._streams.random, rows)
        self.physics.reset(
            rows, states, self.setup.keys(lambda count: self._streams.random(rows, count))
        )
        self.physics.observe(self._compiled()[0].observe_rows, rows, self._observations)
        self._elapsed[rows] = 0
        self._ended[rows] = False
        return self._draws.infos(rows)

    def step(self, actions: Array) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        """Advance every environment by one step.

        Args:
            actions: shape (N, ...).

        Returns:
            Observations (N, k) float32, rewards (N,) float64, terminations and truncations (N,)
            bool, infos.

        Raises:
            ValueError: actions of wrong shape or type, or one that is not in the action space: the
                message names the environment, and none was stepped.
            SimulationDivergedError: a simulation left the finite numbers; the message names the
                environment. All were stepped; once it is reset, by `reset(options={"reset_mask":
                ...})`, they can go on.
            RuntimeError: in `DISABLED` mode, an environment whose episode ended was not reset.
        """
        forces = self.setup.commands.forces(actions)
        if len(forces) != self.num_envs:
            raise ValueError(
                f"actions: {len(forces)} rows for {self.num_envs} environments: there must be one"
                " for each"
            )
        if self.autoreset_mode == AutoresetMode.DISABLED and self._ended.any():
            row = int(np.argmax(self._ended))
            raise RuntimeError(
                f"environment {row} has ended and was not reset: "
                "call reset(options={'reset_mask': terminated | truncated})"
            )
        stepping = ~self._ended  # in NEXT_STEP mode, environments that ended are reset instead
        kernels, steps = self._compiled()
        steps.forces[:], steps.stepping[:] = forces, stepping
        steps.limit[0] = np.inf if self.max_episode_steps is None else self.max_episode_steps
        broken = self.physics.step(kernels.step_rows, steps)
        rewards, terminated, truncated = (
            steps.rewards.copy(),
            steps.terminated.copy(),
            steps.truncated.copy(),
        )
        columns = steps.signals.reshape(-1, *forces.shape).copy()
        self.signals = signals = self.setup.signals([forces, *columns], forces)
        if broken:
            self._ended |= terminated | truncated  # what is to be reset still is
            self.physics.check_finite(self.physics.state, stepping)
        infos = _infos(signals, stepping)
        if not stepping.all():
            infos |= self._restart(np.flatnonzero(~stepping), None)
        self._ended = terminated | truncated
        if self.autoreset_mode == AutoresetMode.SAME_STEP and self._ended.any():
            infos = self._finish(infos)
        return self._observations.copy(), rewards, terminated, truncated, infos

    def _compiled(self) -> tuple[Kernels, VectorStep]:
        """The compiled functions, and what a step is given and fills."""
        if self._kernels is None:
            count, motors = self.num_envs, len(self.task.motors)
            columns = 1 + len(self.setup.plant.family.Signals._fields)
            steps = VectorStep(
                np.empty(count if motors == 1 else (count, motors)),
                np.empty(count, dtype=bool),
                self._observations,
                np.empty(count),
                np.empty(count, dtype=bool),
                np.empty(count, dtype=bool),
                self._elapsed,
                np.empty(1),
                self.setup.options,
                np.empty((columns, count, motors)),
            )
            self._kernels = compiled_kernels(self.setup, self.physics), steps
        return self._kernels

    def _finish(self, infos: dict[str, Any]) -> dict[str, Any]:
        """Reset the environments that ended; what they saw last goes into the infos, as in Gymnasium."""
        ended, rows = self._ended.copy(), np.flatnonzero(self._ended)
        final_obs = np.full(self.num_envs, None, dtype=object)
        for row, seen in zip(rows.tolist(), self._observations[rows], strict=True):
            final_obs[row] = seen
        final: dict[str, Any] = {}
        remaining: dict[str, Any] = {}
        for name in [name for name in infos if not name.startswith("_")]:
            final[name], final[f"_{name}"] = np.zeros_like(infos[name]), ended.copy()
            final[name][rows] = infos[name][rows]
            if len(rows) < self.num_envs:
                remaining[name], remaining[f"_{name}"] = infos[name].copy(), ~ended
                remaining[name][rows] = 0
        drawn = self._restart(rows, None)
        return {
            "final_obs": final_obs,
            "_final_obs": ended.copy(),
            "final_info": final,
            "_final_info": ended.copy(),
            **remaining,
            **drawn,
        }

    def snapshot(self) -> dict[str, Array]:
        """Everything that the future depends on, as plain arrays: simulations, motors, generators, bookkeeping."""
        everything = {
            "physics": self.physics.snapshot(),
            "streams": self._streams.state(),
            "elapsed": self._elapsed.copy(),
            "ended": self._ended.copy(),
            "observations": self._observations.copy(),
        }
        if self.physics.memory.size:
            everything["disturbances"] = self.physics.memory.copy()
        return everything | self._draws.snapshot()

    def restore(self, snapshot: Mapping[str, Array]) -> None:
        """Continue from what `snapshot` returned, bit for bit.

        Raises:
            ValueError: the snapshot is of another number of environments, or of another task.
        """
        check_snapshot(snapshot, self.snapshot())
        self._draws.restore(snapshot)
        self.physics.restore(snapshot["physics"])
        self._streams.set_state(snapshot["streams"])
        self._elapsed[:], self._ended[:] = snapshot["elapsed"], snapshot["ended"]
        self._observations[:] = snapshot["observations"]
        self.signals = None  # of a step that was not this one's past
        if self.physics.memory.size:
            self.physics.memory[:] = snapshot["disturbances"]

    def __getstate__(self) -> dict[str, Any]:
        """Everything but the renderer and the compiled step, which a copy makes anew."""
        return self.__dict__ | {"_renderer": None, "_kernels": None}

    def render(self) -> tuple[Array, ...] | None:  # type: ignore[override]
        """Images of the environments, shape (height, width, 3), uint8; None if there is no render mode."""
        images = [self.image(row) for row in range(self.num_envs if self.render_mode else 1)]
        return None if images[0] is None else tuple(images)  # type: ignore[arg-type]

    def image(self, row: int = 0) -> Array | None:
        """One environment as an image, shape (height, width, 3), uint8; None if there is no render mode."""
        if self.render_mode is None:
            gymnasium.logger.warn(
                "render() without a render mode: pass render_mode='rgb_array' when making it"
            )
            return None
        if self._renderer is None:
            self._renderer = OffscreenRenderer(self.physics.model, **self._view)  # type: ignore[arg-type]
        write_fields(self.physics.model, self._draws.model_fields(np.array([row]), shown=True))
        write_fields(self.physics.model, self.looks, row)
        self.physics.show(row)
        return self._renderer.render(self.physics.data)

    def close_extras(self, **kwargs: Any) -> None:
        """Free the OpenGL context."""
        del kwargs
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None


def check_counts(num_envs: int, max_episode_steps: int | None, each: int = 3_000) -> None:
    """Refuse impossible numbers of environments, each of which takes memory of `each` [bytes], and of steps."""
    limit = {} if max_episode_steps is None else {"max_episode_steps": max_episode_steps}
    for name, count in {"num_envs": num_envs, **limit}.items():
        if isinstance(count, bool) or not isinstance(count, int | np.integer) or count < 1:
            raise ValueError(f"{name} = {count!r}: must be an integer >= 1")
    if (room := free_memory()) is not None and num_envs * each > room:
        raise ValueError(
            f"num_envs = {num_envs}: takes about {num_envs * each / 1e9:.3g} GB of memory, of which"
            f" {room / 1e9:.3g} are free: must be <= {room // each}"
        )


def _infos(signals: Signals, stepping: Array) -> dict[str, Any]:
    """The signals as Gymnasium's vector infos: zero, and masked, where an environment was reset instead of stepped."""
    if not stepping.any():
        return {}
    reset = np.flatnonzero(~stepping)
    infos: dict[str, Any] = {}
    for name, values in signals.items():
        infos[name] = values
        if len(reset):
            infos[name] = values.copy()
            infos[name][reset] = 0
        infos[f"_{name}"] = stepping.copy()
    return infos
