"""Motors for every model that others' code builds from XML: `motors_added`."""

import contextlib
import contextvars
import threading
import warnings
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import mujoco

from codrl_mj.actuators import ActuatorModel
from codrl_mj.engine.specs import add_motors, match_pattern, matchable_names, resolve_patterns
from codrl_mj.tasks import TASKS


class Building:
    """The actuators for models yet to be built, and what was met of these."""

    def __init__(
        self,
        actuators: Mapping[str, ActuatorModel],
        allow_unstable: bool = False,
        joint_dynamics: str | None = None,
        action: str | None = None,
    ) -> None:
        """Take patterns and their actuators, and the action if it is known; a pattern may match nothing in a model."""
        self.actuators, self._action = actuators, action
        self._how = allow_unstable, joint_dynamics
        self._met: dict[str, list[list[str]]] = {}

    @contextlib.contextmanager
    def motorising(self) -> Iterator[None]:
        """Give motors to every model that this thread builds from XML in a `with` block."""
        token = _PRESENT.set(self)
        with _LOCK:
            for name, spec in _SPECS.items() if not _BLOCKS else ():
                _PLAIN.callback(setattr, mujoco.MjModel, name, vars(mujoco.MjModel)[name])
                setattr(
                    mujoco.MjModel, name, staticmethod(_loader(getattr(mujoco.MjModel, name), spec))
                )
            _BLOCKS.append(self)
        try:
            yield
        finally:
            with _LOCK:
                _BLOCKS.remove(self)
                if not _BLOCKS:
                    _PLAIN.close()
            _PRESENT.reset(token)

    def motors_added(
        self, plain: mujoco.MjModel, spec: Callable[[], mujoco.MjSpec]
    ) -> mujoco.MjModel:
        """A model with the motors that are for it; it itself if none are.

        Args:
            plain: the model.
            spec: reads its spec.

        Raises:
            ValueError: see `codrl_mj.add_motors`.
        """
        names = matchable_names(plain)
        self._met[repr(names)] = (
            names  # once each, though some build their model anew at every reset
        )
        wanted = {
            pattern: actuator
            for pattern, actuator in self.actuators.items()
            if match_pattern(pattern, names, needed=False)
        }
        if not wanted:
            return plain
        for pattern, actuator in wanted.items() if self._action == "force" else ():
            plainly = plain.actuator_biastype[match_pattern(pattern, names)] == int(
                mujoco.mjtBias.mjBIAS_NONE
            )
            if actuator.MOTION and actuator.commands() and plainly.any():
                raise ValueError(
                    f"action = 'force': {pattern!r}: the environment asks its actuators for forces,"
                    f" and a {type(actuator).__name__} is asked for motions; must be"
                    f" {' or '.join(actuator.commands())}"
                )
        with (
            warnings.catch_warnings()
        ):  # MuJoCo's of the model, which building it without motors has shown
            ours = r"codrl_mj\.(engine\.specs|foreign\.building)"
            warnings.filterwarnings("ignore", category=UserWarning, module=ours)
            return add_motors(spec(), wanted, *self._how).compile()

    def check(self, env_id: str = "") -> None:
        """Refuse patterns that matched nothing, and an environment, of Gymnasium's if it has an id, without a model."""
        if not self._met and env_id:
            task = next((task.name for task in TASKS.values() if task.gymnasium_id == env_id), None)
            remedy = (
                f"take {task!r}, our task of it that has"
                if task
                else "only environments that have can get motors"
            )
            raise ValueError(
                f"the environment has no MuJoCo model built from XML, and so no motors: {remedy}"
            )
        if not self._met:
            raise ValueError(
                f"actuators = {list(self.actuators)}: no model was built inside by"
                " MjModel.from_xml_path or from_xml_string in this thread; build the environment"
                " inside, or put motors into its MjSpec with codrl_mj.add_motors"
            )
        for pattern in self.actuators:
            match_pattern(pattern, [own for names in self._met.values() for own in names])


@contextlib.contextmanager
def motors_added(
    actuators: Mapping[Any, Any], allow_unstable: bool = False, joint_dynamics: str | None = None
) -> Iterator[None]:
    """Put motors into any environment that is built inside: Gymnasium's, dm_control's, anybody's.

    Models that this thread builds by `mujoco.MjModel.from_xml_path` or `from_xml_string` in the
    block go through `codrl_mj.add_motors`. Of nested blocks the innermost counts. What builds its
    model again later, as composer environments of dm_control do at every reset, has to do so inside
    too (`codrl_mj.make_dm_control` sees to that).

        >>> with codrl_mj.motors_added({".*": "maxon-ec45-flat-50w"}):
        ...     env = gym.make("HalfCheetah-v5")

    Args:
        actuators: as for `codrl_mj.add_motors`; a pattern has to match something in one of the models
            at least.
        allow_unstable: likewise.
        joint_dynamics: likewise.

    Raises:
        ValueError: see `codrl_mj.add_motors`; or, at the end, no model was built inside, or a pattern
            matched nothing.
    """
    building = Building(
        resolve_patterns(actuators, "another's environment"), allow_unstable, joint_dynamics
    )
    with building.motorising():
        yield
    building.check()


_PRESENT: contextvars.ContextVar[Building | None] = contextvars.ContextVar("present", default=None)
"""What the models of this thread are built with."""


_SPECS: dict[str, Callable[..., mujoco.MjSpec]] = {
    "from_xml_path": lambda filename, assets=None, vfs=None: mujoco.MjSpec.from_file(
        filename, include=assets, assets=assets, vfs=vfs
    ),
    "from_xml_string": lambda xml, assets=None, vfs=None: mujoco.MjSpec.from_string(
        xml, include=assets, assets=assets, vfs=vfs
    ),
}
"""MuJoCo's two ways to build a model from XML -> what reads its spec from the same arguments."""
_LOCK, _PLAIN = threading.Lock(), contextlib.ExitStack()
_BLOCKS: list[Building] = []
"""The blocks of `motorising` that any thread is in: while there are any, models are built by `_loader`s."""


def _loader(
    plain: Callable[..., mujoco.MjModel], spec: Callable[..., mujoco.MjSpec]
) -> Callable[..., mujoco.MjModel]:
    def load(*arguments: Any, **options: Any) -> mujoco.MjModel:
        model, building = plain(*arguments, **options), _PRESENT.get()
        return (
            model
            if building is None
            else building.motors_added(model, lambda: spec(*arguments, **options))
        )

    return load
