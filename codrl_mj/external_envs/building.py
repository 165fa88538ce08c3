"""Motors for every model that third-party code builds from XML: `motors_added`."""

import contextlib
import contextvars
import threading
import warnings
from collections.abc import Callable, Iterator, Mapping

import mujoco

from codrl_mj.actuators import ActuatorModel, ActuatorSetting
from codrl_mj.boundary import Argument
from codrl_mj.engine.matching import match_pattern, matchable_names, resolve_patterns
from codrl_mj.engine.specs import add_motors
from codrl_mj.envs.commands import commands_by_pattern
from codrl_mj.envs.config import EnvConfig
from codrl_mj.tasks import TASKS


class ModelPatcher:
    """Patch of MuJoCo's XML loaders that adds motors to every model they build.

    It records the names in these models, so that `check` can report a pattern without a match.
    """

    def __init__(
        self,
        actuators: Mapping[str, ActuatorModel],
        allow_unstable: bool = False,
        joint_dynamics: str | None = None,
        action: str | None = None,
    ) -> None:
        """Store arguments of `add_motors`, and the action, if known; nothing is matched yet."""
        self.actuators, self._action = actuators, action
        self._add_motors_arguments = allow_unstable, joint_dynamics
        self._names_of_models: dict[str, list[list[str]]] = {}

    @contextlib.contextmanager
    def patch_model_loading(self) -> Iterator[None]:
        """Add motors to every model that this thread builds from XML in a `with` block."""
        token = _ACTIVE_PATCHER.set(self)
        with _LOCK:
            # The first open block of any thread replaces the loaders; the last one restores them.
            for name, read_spec in _SPEC_READERS.items() if not _OPEN_BLOCKS else ():
                _LOADER_RESTORER.callback(setattr, mujoco.MjModel, name, vars(mujoco.MjModel)[name])
                setattr(
                    mujoco.MjModel,
                    name,
                    staticmethod(_patched_loader(getattr(mujoco.MjModel, name), read_spec)),
                )
            _OPEN_BLOCKS.append(self)
        try:
            yield
        finally:
            with _LOCK:
                _OPEN_BLOCKS.remove(self)
                if not _OPEN_BLOCKS:
                    _LOADER_RESTORER.close()
            _ACTIVE_PATCHER.reset(token)

    def motors_added(
        self, model: mujoco.MjModel, read_spec: Callable[[], mujoco.MjSpec]
    ) -> mujoco.MjModel:
        """Return a model with the motors that match it; the same model if none match.

        Args:
            model: the model without motors.
            read_spec: function that reads the model's spec.

        Raises:
            ValueError: see `codrl_mj.add_motors`.
        """
        names = matchable_names(model)
        # A dictionary, because some environments build the same model at every reset.
        self._names_of_models[repr(names)] = names
        matching = {
            pattern: actuator
            for pattern, actuator in self.actuators.items()
            if match_pattern(pattern, names, needed=False)
        }
        if not matching:
            return model
        for pattern, actuator in matching.items() if self._action == "force" else ():
            is_force_actuator = model.actuator_biastype[match_pattern(pattern, names)] == int(
                mujoco.mjtBias.mjBIAS_NONE
            )
            if actuator.MOTION and actuator.commands() and is_force_actuator.any():
                raise ValueError(
                    f"action = 'force': {pattern!r}: the environment's actions are forces, but a"
                    f" {type(actuator).__name__} takes motions; must be"
                    f" {' or '.join(actuator.commands())}"
                )
        # Building the model without motors has already shown MuJoCo's warnings about it; the second
        # build would repeat them.
        with warnings.catch_warnings():
            own_modules = r"codrl_mj\.(engine\.specs|external_envs\.building)"
            warnings.filterwarnings("ignore", category=UserWarning, module=own_modules)
            return add_motors(read_spec(), matching, *self._add_motors_arguments).compile()

    def check(self, env_id: str = "", label: str = "") -> None:
        """Raise if a pattern matched nothing, or if no model was built from XML.

        `env_id` is the id of a Gymnasium environment, and `label` a prefix, for the message.
        """
        if not self._names_of_models and env_id:
            task = next((task.name for task in TASKS.values() if task.gymnasium_id == env_id), None)
            remedy = (
                f"use this package's task {task!r}, which has motors"
                if task
                else "only environments that build such a model while they are made can get motors;"
                " add motors to the MjSpec of any other model with codrl_mj.add_motors"
            )
            raise ValueError(
                f"{label}the environment has no MuJoCo model built from XML, and so no motors:"
                f" {remedy}"
            )
        if not self._names_of_models:
            raise ValueError(
                f"actuators = {list(self.actuators)}: no model was built in the block by"
                " MjModel.from_xml_path or from_xml_string in this thread; build the environment in"
                " the block, or add motors to its MjSpec with codrl_mj.add_motors"
            )
        for pattern in self.actuators:
            match_pattern(
                pattern,
                [names for model_names in self._names_of_models.values() for names in model_names],
            )


def patcher_of(config: EnvConfig) -> ModelPatcher:
    """Return the patcher that adds a configuration's motors."""
    actuators = {
        pattern: command.actuator for pattern, command in commands_by_pattern(config).items()
    }
    return ModelPatcher(actuators, config.allow_unstable, config.joint_dynamics, config.action)


@contextlib.contextmanager
def motors_added(
    actuators: Mapping[str, ActuatorSetting],
    allow_unstable: bool = False,
    joint_dynamics: str | None = None,
) -> Iterator[None]:
    """Add motors to each environment that any library builds in a `with` block.

    Models that this thread builds by `mujoco.MjModel.from_xml_path` or `from_xml_string` in the
    block pass through `codrl_mj.add_motors`. In nested blocks the innermost applies. An environment
    that builds its model again later, as composer environments of dm_control do at every reset,
    must do so in such a block too (`codrl_mj.make_dm_control` ensures this).

        >>> with codrl_mj.motors_added({".*": "maxon-ec45-flat-50w"}):
        ...     env = gym.make("HalfCheetah-v5")

    Args:
        actuators: as for `codrl_mj.add_motors`; each pattern must match something in at least one
            of the models.
        allow_unstable: as for `codrl_mj.add_motors`.
        joint_dynamics: as for `codrl_mj.add_motors`.

    Raises:
        ValueError: see `codrl_mj.add_motors`; or, at the end of the block, no model was built, or a
            pattern matched nothing.
    """
    patcher = ModelPatcher(
        resolve_patterns(actuators, "a third-party environment"), allow_unstable, joint_dynamics
    )
    with patcher.patch_model_loading():
        yield
    patcher.check()


_ACTIVE_PATCHER: contextvars.ContextVar[ModelPatcher | None] = contextvars.ContextVar(
    "active_patcher", default=None
)
"""Patcher of the innermost block of this thread."""


_SPEC_READERS: dict[str, Callable[..., mujoco.MjSpec]] = {
    "from_xml_path": lambda filename, assets=None, vfs=None: mujoco.MjSpec.from_file(
        filename, include=assets, assets=assets, vfs=vfs
    ),
    "from_xml_string": lambda xml, assets=None, vfs=None: mujoco.MjSpec.from_string(
        xml, include=assets, assets=assets, vfs=vfs
    ),
}
"""MuJoCo's functions that build a model from XML -> readers of its spec with the same arguments."""
_LOCK, _LOADER_RESTORER = threading.Lock(), contextlib.ExitStack()
"""Lock of the two following objects, and the stack that restores MuJoCo's functions."""
_OPEN_BLOCKS: list[ModelPatcher] = []
"""Patchers of the open blocks of all threads; while there are any, the loaders are replaced."""


def _patched_loader(
    original: Callable[..., mujoco.MjModel], read_spec: Callable[..., mujoco.MjSpec]
) -> Callable[..., mujoco.MjModel]:
    """Return a replacement for a loader of MuJoCo that adds motors to the loaded model."""

    # MuJoCo's functions are replaced for all threads; the context variable restricts the motors to
    # the thread of the block.
    def load(*arguments: Argument, **options: Argument) -> mujoco.MjModel:
        model, patcher = original(*arguments, **options), _ACTIVE_PATCHER.get()
        return (
            model
            if patcher is None
            else patcher.motors_added(model, lambda: read_spec(*arguments, **options))
        )

    return load
