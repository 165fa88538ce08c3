"""Contract between a policy and its controller, in the file `contract.json`.

A policy on a board fails silently if an angle is in degrees, two entries are swapped or the loop
runs at another rate. The contract therefore records all assumptions of the policy, and its methods
raise an error if one does not hold.
"""

import contextlib
import copy
import dataclasses
import hashlib
import importlib.metadata
import json
import platform
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TypedDict

import numpy as np

from codrl_mj.actuators import ActuatorModel, allow_imports, mapping_of
from codrl_mj.boundary import JsonObject
from codrl_mj.deploy.loops import loop_parameters
from codrl_mj.deploy.network import extract_network
from codrl_mj.deploy.spaces import Entries, describe_spaces
from codrl_mj.envs.config import Env, EnvConfig
from codrl_mj.evaluation import run_episodes
from codrl_mj.fields import check_names, did_you_mean, differences
from codrl_mj.runs.files import read_json, with_digest, write_json
from codrl_mj.runs.policies import Policy

FORMAT = "codrl_mj contract 1"
FILE = "contract.json"
NUM_GOLDEN = 200
"""Number of golden observations, stored with the policy's actions to test other runtimes."""
GOLDEN_TOLERANCE = 1e-5
"""Tolerance of other runtimes' commands, relative to the largest golden command, at least 1."""
LATE_PERIODS = 1.5
"""Number of periods after which a missing command is late."""
_PACKAGES = ("codrl-mj", "mujoco", "gymnasium", "numpy", "stable-baselines3", "torch")


def _step_duration(env: Env) -> float:
    """Return the simulated time between two actions [s].

    A task's environment stores the duration. For other environments it is measured, because their
    `dt` does not include wrappers, such as one that repeats actions.
    """
    recorder = env.get_wrapper_attr("recorder")
    actions = copy.deepcopy(env.action_space)
    durations = list[float]()
    is_task = recorder is env.unwrapped
    if is_task:
        return float(recorder.step_duration)
    actions.seed(0)
    env.reset(seed=0)
    for _ in range(5):
        *_, terminated, truncated, _ = env.step(actions.sample())
        # The last step of an episode may be cut short.
        if not durations or not (terminated or truncated):
            durations.append(recorder.step_duration)
        if terminated or truncated:
            break
    if min(durations) <= 0.0 or not np.allclose(durations, durations[0], rtol=1e-6, atol=0.0):
        raise ValueError(
            f"rate: the environment's first steps take {durations} s: must be equal and above 0, as"
            " a controller has one rate"
        )
    return durations[0]


@dataclasses.dataclass(frozen=True)
class Interface:
    """Observations and actions between a policy and the controlled system."""

    task: str
    """Name of the environment."""
    rate: float
    """Actions per second [Hz]."""
    observations: Entries
    """Entries of an observation, in order."""
    actions: Entries
    """Entries of an action, in order."""

    @classmethod
    def from_env(cls, env: EnvConfig) -> "Interface":
        """Return the interface of an environment."""
        with contextlib.closing(env.build()) as instance:
            rate = 1.0 / _step_duration(instance)
        return cls(env.task, rate, *describe_spaces(env))

    @property
    def levels(self) -> np.ndarray | None:
        """Commands of discrete actions, shape (choices, m), in the units of `actions`.

        None if the actions are continuous, or if the commands are unknown.
        """
        levels = [entry["levels"] for entry in self.actions if "levels" in entry]
        return np.array(levels, dtype=np.float64).T if levels else None

    def to_commands(self, actions: np.ndarray) -> np.ndarray:
        """Return commands (n, m) in the units of `actions` for actions (n, m) or indices (n,)."""
        return actions.reshape(len(actions), -1) if self.levels is None else self.levels[actions]

    def to_actions(self, commands: np.ndarray) -> np.ndarray:
        """Return actions (n, m) for commands (n, m), or the indices (n,) of the nearest levels."""
        # Without levels a discrete action of a third-party environment is its index.
        if (levels := self.levels) is None:
            return (
                commands.astype(np.float32)
                if "least" in self.actions[0]
                else commands[:, 0].round().astype(int)
            )
        nearest: np.ndarray = np.abs(commands[:, None, :] - levels).sum(axis=2).argmin(axis=1)
        return nearest

    def check_observations(
        self, observations: Sequence[tuple[str, str | None]], rate: float | None = None
    ) -> None:
        """Raise an error if observations are not those of the policy.

        Args:
            observations: name and unit of each entry, in their order; a unit of None is not
                compared.
            rate: observations per second [Hz]; None is not compared.

        Raises:
            ValueError: entries are missing, unknown, in another order or unit, or come at another
                rate.
        """
        names = [entry["name"] for entry in self.observations]
        received = [name for name, _ in observations]
        if unknown := [name for name in received if name not in names]:
            raise ValueError(
                f"observation {unknown[0]!r}: unknown to the policy;"
                f" {did_you_mean(unknown[0], names)}it has {', '.join(names)}"
            )
        if missing := [name for name in names if name not in received]:
            raise ValueError(
                f"observations: {', '.join(missing)} missing: the policy takes {', '.join(names)}"
            )
        if received != names:
            raise ValueError(
                f"observations: their order is {', '.join(received)}, must be {', '.join(names)}:"
                " reorder the columns"
            )
        for (name, unit), entry in zip(observations, self.observations, strict=True):
            if unit is not None and entry["unit"] is not None and unit != entry["unit"]:
                raise ValueError(
                    f"observation {name!r}: its unit is {unit}, must be {entry['unit']}: convert it"
                )
        if rate is not None and abs(rate / self.rate - 1.0) > 0.01:
            raise ValueError(
                f"rate: observations come at {rate:.4g} Hz, must be {self.rate:.4g} Hz, at which"
                " the policy was trained"
            )


class RecordedActuator(TypedDict):
    """Actuator of a motor in the training."""

    fields: JsonObject | None
    """Fields of the actuator; None if it is ideal."""
    sha256: str
    """Digest of the fields."""


class Controller(TypedDict):
    """Properties of the C code."""

    real: str
    """Number type, `float` or `double`."""
    loop: JsonObject | None
    """Parameters of the current loop, see `loop_parameters`; None if the code closes none."""


class Late(TypedDict):
    """Reaction to a late observation or command."""

    after: float
    """Time after which it is late."""
    unit: str
    """Unit of the time."""
    command: list[float]
    """Safe command that is used then."""


class Golden(TypedDict):
    """Golden observations of a policy and its actions."""

    observations: list[list[float]]
    """Observations, shape (n, k)."""
    actions: list[list[float]] | list[int]
    """The policy's actions, shape (n, m), or indices (n,)."""
    tolerance: float
    """Largest error of another runtime's commands."""


@dataclasses.dataclass(frozen=True)
class Contract(Interface):
    """Contents of the contract file."""

    agent: str
    """Name of the trained agent."""
    actuators: dict[str, RecordedActuator]
    """Motor name or pattern -> its actuator."""
    assumed: JsonObject
    """Environment of the training, as a mapping for `EnvConfig.from_mapping`."""
    controller: Controller
    """Number type and current loop of the C code."""
    limits: dict[str, list[float | None]]
    """Observation -> smallest and largest safe value; beyond them the safe command is used."""
    late: Late
    """Reaction to a late observation or command."""
    golden: Golden
    """Golden values, to test other runtimes."""
    versions: dict[str, str]
    """Versions of the software that wrote the contract."""

    @classmethod
    def from_policy(
        cls,
        policy: Policy,
        env: EnvConfig,
        agent: str,
        episodes: int = 5,
        seed: int = 0,
        limits: Mapping[str, float] | None = None,
        double: bool = False,
    ) -> "Contract":
        """Create the contract of a policy that was trained in an environment.

        Args:
            policy: as `codrl_mj.runs.policies.load_policy` returns it.
            env: the environment of the training.
            agent: name of the agent that trained the policy.
            episodes: number of whole episodes for the golden values; the same number is added while
                they have too few observations.
            seed: seed of the first episode.
            limits: observation -> largest safe magnitude, in its unit. An angle that is observed as
                `cos_NAME` and `sin_NAME` is called NAME and must be below pi.
            double: True if the C code computes in double, False for float.

        Raises:
            ValueError: the policy cannot be exported or was trained with other observations or
                actions, `episodes` is below 1, or a limit is unknown or not positive.
        """
        network = extract_network(policy)
        # The bounds of the actions scale the exported commands.
        golden_episodes = run_episodes(policy, env.build, episodes, seed, same_bounds=True)
        # A policy that fails at once has short episodes.
        while sum(len(episode.time) for episode in golden_episodes) < NUM_GOLDEN:
            golden_episodes += run_episodes(
                policy, env.build, episodes, seed + len(golden_episodes)
            )
        observations = np.concatenate([episode.observation[:-1] for episode in golden_episodes])
        golden_observations = observations[
            np.unique(np.linspace(0, len(observations) - 1, NUM_GOLDEN).astype(int))
        ]
        interface = Interface.from_env(env)
        for index, entry in enumerate(interface.observations):
            entry |= network.input_scaling(index)
            entry["seen"] = [
                float(observations[:, index].min()),
                float(observations[:, index].max()),
            ]
        actions = policy.predict(golden_observations, deterministic=True)[0]
        largest = max(1.0, float(np.abs(interface.to_commands(actions)).max()))
        return cls(
            **vars(interface),
            agent=agent,
            actuators={
                name: _with_digest(mapping_of(actuator))
                for name, actuator in env.actuators_by_name.items()
            },
            # The round trip turns tuples into lists, as in a contract that is read from a file.
            assumed=json.loads(json.dumps(env.as_mapping())),
            controller={"real": "double" if double else "float", "loop": loop_parameters(env)},
            limits=_limits([entry["name"] for entry in interface.observations], limits or {}),
            late={
                "after": LATE_PERIODS / interface.rate,
                "unit": "s",
                "command": [0.0] * len(interface.actions),
            },
            golden={
                "observations": golden_observations.tolist(),
                "actions": actions.tolist(),
                "tolerance": GOLDEN_TOLERANCE * largest,
            },
            versions={
                "python": platform.python_version(),
                **{package: importlib.metadata.version(package) for package in _PACKAGES},
            },
        )

    @classmethod
    def read(cls, folder: Path) -> "Contract":
        """Read the contract of an exported folder, or a contract file.

        Raises:
            FileNotFoundError: there is no contract.
            ValueError: the file is damaged, edited, or not a contract.
        """
        path = folder / FILE if folder.is_dir() else folder
        content = read_json(path, "contract")
        if not isinstance(content, dict) or content.get("format") != FORMAT:
            raise ValueError(
                f"{path}: not a contract of this program: its format must be {FORMAT!r}"
            )
        entries = [field.name for field in dataclasses.fields(cls)]
        if missing := [name for name in entries if name not in content]:
            raise ValueError(f"{path}: has no {', '.join(missing)}: export it again")
        return cls(**{name: content[name] for name in entries})

    def environment(self, trust: bool = False) -> EnvConfig:
        """Return the environment of the training.

        Args:
            trust: True to import the modules that it names; otherwise they raise an error.
        """
        with allow_imports(trust):
            return EnvConfig.from_mapping(self.assumed)

    def write(self, folder: Path) -> None:
        """Write `contract.json` into a folder atomically, with a digest of its content."""
        write_json(folder / FILE, with_digest({"format": FORMAT, **dataclasses.asdict(self)}))

    def is_within_limits(self, observations: np.ndarray) -> np.ndarray:
        """Return True for observations (N, k) that are finite and within the limits, shape (N,)."""
        is_safe: np.ndarray = np.isfinite(observations).all(axis=1)
        for index, entry in enumerate(self.observations):
            lower, upper = self.limits.get(entry["name"], (None, None))
            is_safe &= (lower is None or observations[:, index] >= lower) & (
                upper is None or observations[:, index] <= upper
            )
        return is_safe

    def check_actuators(self, actuators: Mapping[str, ActuatorModel]) -> None:
        """Raise an error if actuators are not those of the training.

        Args:
            actuators: motor name or pattern -> `ActuatorModel`.

        Raises:
            ValueError: an actuator differs; the message names the first field that does.
        """
        for name, trained in self.actuators.items():
            if name not in actuators:
                raise ValueError(
                    f"actuator {name!r}: missing: the policy was trained with {trained['fields']}"
                )
            actual = _with_digest(mapping_of(actuators[name]))
            if actual["sha256"] != trained["sha256"]:
                changed = differences(trained["fields"] or {}, actual["fields"] or {})
                field, (expected, value) = next(iter(changed.items()), ("family", (None, None)))
                raise ValueError(
                    f"actuator {name!r}: {field} = {value}, must be {expected}, with which the"
                    " policy was trained; evaluate the policy with yours, or train with it"
                )


def _limits(names: list[str], limits: Mapping[str, float]) -> dict[str, list[float | None]]:
    """Return the smallest and largest safe value of each limited observation.

    Args:
        names: names of all observations.
        limits: observation or angle -> its largest safe magnitude.
    """
    angles = [name.removeprefix("cos_") for name in names if name.startswith("cos_")]
    check_names(limits, [*names, *angles], "limit")
    for name, largest in limits.items():
        if not 0.0 < largest < (np.pi if name in angles else np.inf):
            raise ValueError(
                f"limit {name} = {largest:g}: must be > 0{' and < pi' if name in angles else ''},"
                " and finite"
            )
    # For a limit below pi, an angle is within +-limit if and only if its cosine is at least the
    # limit's cosine.
    return {
        f"cos_{name}" if name in angles else name: (
            [float(np.cos(largest)), None] if name in angles else [-largest, largest]
        )
        for name, largest in limits.items()
    }


def _with_digest(fields: JsonObject | None) -> RecordedActuator:
    """Return fields with their digest."""
    digest = hashlib.sha256(json.dumps(fields, sort_keys=True).encode()).hexdigest()
    return {"fields": fields, "sha256": digest}
