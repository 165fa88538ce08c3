"""SARSA: episodic semi-gradient SARSA with tile coding."""

import dataclasses
from typing import ClassVar

from gymnasium import spaces

from codrl_mj.agents.base import AgentConfig, AgentModel, AgentPolicy, TrainingEnvs
from codrl_mj.envs.config import Space
from codrl_mj.fields import integer, positive_integers, real, reals


@dataclasses.dataclass(frozen=True)
class SARSAConfig(AgentConfig):
    """Episodic semi-gradient SARSA with tile coding (Sutton and Barto, 2018, sections 9.5.4, 10.1).

    The defaults are the paper's: 8 tilings of 9 x 9 tiles for 3 actions, 1944 weights. Each of the
    `intervals` covers one leading entry of the observation, or one angle. Further entries, such as
    those that `observe_actuator` appends, are ignored unless `intervals`, `low` and `high` include
    them. Entries outside their bounds are in the outer tiles.
    """

    name: ClassVar[str] = "sarsa"
    action_spaces: ClassVar[tuple[type[Space], ...]] = (spaces.Discrete,)

    step_size: float = real(0.0375, above=0)
    """Step size alpha of each weight, > 0; 1/tilings would set an estimate to its target in one
    step. The paper: 0.0375.
    """
    gamma: float = real(1.0, above=0, maximum=1)
    """Discount factor, in (0, 1]. The paper: 1."""
    epsilon: float = real(0.001, minimum=0, maximum=1)
    """Probability of a random action in the first episode, in [0, 1]. The paper: 0.001."""
    epsilon_decay: float = real(1.0, above=0, maximum=1)
    """Factor that multiplies epsilon after every episode, in (0, 1]. The paper: 1."""
    trace_decay: float = real(0.0, minimum=0, maximum=1)
    """Decay lambda of replacing traces, in [0, 1]. The paper: 0, no traces."""
    tilings: int = integer(8, minimum=1)
    """Number of grids of tiles, a power of 2. The paper: 8."""
    intervals: tuple[int, ...] = positive_integers((8, 8))
    """Tiles between the bounds, >= 1, of each angle, then of other entries. The paper: 8, 8."""
    angles: int = integer(0, minimum=0)
    """Number of pairs of cosine and sine at the beginning of the observation, each of which is
    tiled as an angle (Acrobot: 2).
    """
    low: tuple[float, ...] | None = reals()
    """Lower bounds of the tiled entries that are not angles; none: the observation space's."""
    high: tuple[float, ...] | None = reals()
    """Upper bounds of these entries; none: the observation space's."""
    initial_value: float = real(0.0)
    """Initial estimate of every action's return; an optimistic one makes the agent try all actions.
    The paper: 0, with rewards of -1.
    """

    def make_model(self, env: TrainingEnvs, seed: int) -> AgentModel:
        """See `AgentConfig.make_model`.

        Raises:
            ValueError: there is more than one environment, or its observations or actions do not
                fit the tiles.
        """
        from codrl_mj.agents.sarsa_algorithm import SARSA, TileCodingPolicy

        return SARSA(TileCodingPolicy, env, self, seed=seed)

    def make_policy(self, observation_space: spaces.Box, action_space: Space) -> AgentPolicy:
        """See `AgentConfig.make_policy`."""
        from codrl_mj.agents.sarsa_algorithm import TileCodingPolicy

        return TileCodingPolicy(observation_space, action_space, self)
