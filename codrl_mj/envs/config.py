"""The environment's arguments as a configuration, for training runs and the command line."""

import dataclasses
from collections.abc import Mapping
from typing import Any, Literal

from codrl_mj.disturbances import OFF, Disturbances, resolve_disturbances
from codrl_mj.envs.distributions import Distribution, parse


@dataclasses.dataclass(frozen=True)
class EnvConfig:
    """Arguments of an environment other than task, actuator and rendering; None leaves the task's default.

    Raises:
        ValueError: `max_episode_steps` or a disturbance is out of bounds, or a distribution is none; the environment
            checks the rest.
    """

    physics: Literal["mujoco", "analytic"] = "mujoco"
    """`mujoco`, or `analytic`: Gymnasium's own equations."""
    integrator: str | None = None
    """One of the task's integrators (CartPole: `euler` or `semi-implicit`); the default is Gymnasium's."""
    inner_steps: int | None = None
    """Integration steps per environment step; the default is the paper's inner loop with a motor and 1 without."""
    action: Literal["force", "current", "voltage"] = "force"
    """What the agent commands: the desired force, the reference current, or the voltage past the controller."""
    levels: tuple[float, ...] | None = None
    """Discrete tasks that command a current [A] or a voltage [V]: the levels that the actions choose from."""
    observe_actuator: bool = False
    """Whether the agent also observes measured and reference current [A]."""
    max_episode_steps: int | None = None
    """Time limit [environment steps], >= 1; the default is Gymnasium's."""
    center_radius: float | None = None
    """CartPole: distance from the centre [m] beyond which a step earns nothing. The paper trains with 0.1."""
    allow_unstable: bool = False
    """Build the environment even if the current loop is unstable."""
    disturbances: Disturbances = OFF
    """Imperfections of drive, sensor, supply and joint, and load pulses; each is off at 0."""
    randomize: tuple[str, ...] | None = None
    """What to draw at every reset, as FIELD=DISTRIBUTION, such as 'motor.inductance=uniform(0.05, 0.2)'; distributions
    are uniform(LOW, HIGH), loguniform(LOW, HIGH) and choice(VALUE, ...). In Python and in files a mapping of fields to
    distributions will do as well."""

    def __post_init__(self) -> None:
        """Validate what the environment itself does not see."""
        if self.levels is not None:
            object.__setattr__(self, "levels", tuple(self.levels))  # JSON has lists
        object.__setattr__(self, "disturbances", resolve_disturbances(self.disturbances))  # JSON has mappings
        if self.randomize is not None:
            object.__setattr__(self, "randomize", _written(self.randomize))
        limit = self.max_episode_steps
        if limit is not None and (isinstance(limit, bool) or not isinstance(limit, int) or limit < 1):
            raise ValueError(f"max_episode_steps = {limit!r}: must be an integer >= 1")

    def seen_as(self, trained: "EnvConfig") -> "EnvConfig":
        """This environment with the actions and observations of another: those that a policy was trained with."""
        interface = {name: getattr(trained, name) for name in ("action", "levels", "observe_actuator")}
        return dataclasses.replace(self, **interface)

    def as_arguments(self) -> dict[str, Any]:
        """The keyword arguments for `gymnasium.make`, without those left at the task's default."""
        arguments = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        if self.randomize is not None:
            arguments["randomize"] = {name: parse(text) for name, text in map(_split, self.randomize)}
        return {name: value for name, value in arguments.items() if value is not None and value != OFF}


def _written(randomize: Any) -> tuple[str, ...]:
    """Fields and distributions as hashable, JSON-serialisable text, in the order in which they are drawn.

    Args:
        randomize: a mapping of fields to distributions or their text, or a sequence of 'FIELD=DISTRIBUTION'.

    Raises:
        ValueError: it is neither or empty, a field is named twice, or a distribution is none.
    """
    if isinstance(randomize, str) or not isinstance(randomize, Mapping | list | tuple) or not randomize:
        raise ValueError(
            f"randomize = {randomize!r}: must be one or more of FIELD=DISTRIBUTION, or a mapping of fields to these"
        )
    pairs = randomize.items() if isinstance(randomize, Mapping) else map(_split, randomize)
    written: dict[str, str] = {}
    for name, distribution in pairs:
        if name in written:
            raise ValueError(f"randomize: {name} is named twice: give it one distribution")
        try:
            written[name] = str(distribution if isinstance(distribution, Distribution) else parse(distribution))
        except ValueError as error:
            raise ValueError(f"randomize: {name}: {error}") from None
    return tuple(f"{name}={text}" for name, text in written.items())


def _split(item: Any) -> tuple[str, str]:
    """Field and distribution of 'FIELD=DISTRIBUTION'.

    Raises:
        ValueError: it has no field or no '='.
    """
    name, equals, text = item.partition("=") if isinstance(item, str) else ("", "", "")
    if not equals or not name.strip():
        raise ValueError(
            f"randomize: {item!r}: must be FIELD=DISTRIBUTION, such as 'motor.inductance=uniform(0.05, 0.2)'"
        )
    return name.strip(), text
