"""What a policy and its controller assume of each other, in one file: `contract.json`.

A policy on a board fails quietly where an angle comes in degrees, two entries change places or the
loop runs at another rate. So all of it is written down, and a reader refuses what differs.
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
from typing import Any

import numpy as np

from codrl_mj.actuators import mapping_of, trusting
from codrl_mj.deploy.loops import current_loop
from codrl_mj.deploy.network import network_of
from codrl_mj.envs.config import EnvConfig
from codrl_mj.evaluation import run_episodes
from codrl_mj.fields import check_names, did_you_mean, differing
from codrl_mj.runs.files import read_json, with_digest, write_json
from codrl_mj.runs.policies import Policy

FORMAT = "codrl_mj contract 1"
FILE = "contract.json"
GOLDEN = 200
"""Observations of episodes that are kept with their actions, for whoever computes them elsewhere."""
CLOSE = 1e-5
"""Share of the largest golden command, and at least of 1, that those of others may be off."""
LATE = 1.5
"""Periods after which a command that has not come is late."""
_PACKAGES = ("codrl-mj", "mujoco", "gymnasium", "numpy", "stable-baselines3", "torch")


def _step_duration(env: Any) -> float:
    """Return the simulated time [s] between two actions: a task's own, else measured: a `dt` knows no wrappers."""
    recorder, actions, durations = (
        env.get_wrapper_attr("recorder"),
        copy.deepcopy(env.action_space),
        list[float](),
    )
    if recorder is env.unwrapped:
        return float(recorder.step_duration)
    actions.seed(0)
    env.reset(seed=0)
    for _ in range(5):
        *_, terminated, truncated, _ = env.step(actions.sample())
        if not durations or not (
            terminated or truncated
        ):  # the last step of an episode may be cut short
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
    """What passes between a policy and whatever it controls."""

    task: str
    """The environment's name."""
    rate: float
    """Actions a second [Hz]."""
    observations: list[dict[str, Any]]
    """Entries of an observation in their order: `name`, `unit`, bounds `least` and `most`; of a
    contract's also `scale` and `offset` before the first layer (done by the policy itself), and
    `seen`, the least and the most of the golden episodes.
    """
    actions: list[dict[str, Any]]
    """Entries of an action, likewise; a discrete one has the `levels` that its indices stand for."""

    @classmethod
    def between(cls, env: EnvConfig) -> "Interface":
        """That of an environment."""
        with contextlib.closing(env.make()) as made:
            rate = 1.0 / _step_duration(made)
        return cls(env.task, rate, *env.world.interface(env))

    @property
    def levels(self) -> np.ndarray | None:
        """What discrete actions stand for, (choices, m) in the units of `actions`; None of others, or if not known."""
        levels = [one["levels"] for one in self.actions if "levels" in one]
        return np.array(levels, dtype=np.float64).T if levels else None

    def commands(self, actions: np.ndarray) -> np.ndarray:
        """Commands (n, m) in the units of `actions`, for actions (n, m), or indices (n,) of the levels."""
        return actions.reshape(len(actions), -1) if self.levels is None else self.levels[actions]

    def actions_of(self, commands: np.ndarray) -> np.ndarray:
        """The actions (n, m) for commands (n, m), or the indices (n,) of the levels that are nearest to them."""
        if (
            levels := self.levels
        ) is None:  # of a discrete action of others nobody knows more than the index
            return (
                commands.astype(np.float32)
                if "least" in self.actions[0]
                else commands[:, 0].round().astype(int)
            )
        return np.abs(commands[:, None, :] - levels).sum(axis=2).argmin(axis=1)

    def admit(
        self, observations: Sequence[tuple[str, str | None]], rate: float | None = None
    ) -> None:
        """Refuse observations that are not those of the policy.

        Args:
            observations: name and unit of each entry, in the order in which they come; a unit of
                None is not compared.
            rate: how many come in a second [Hz]; None is not compared.

        Raises:
            ValueError: entries are missing, unknown, in another order or unit, or come at another
                rate.
        """
        names, given = (
            [one["name"] for one in self.observations],
            [name for name, _ in observations],
        )
        if unknown := [name for name in given if name not in names]:
            raise ValueError(
                f"observation {unknown[0]!r}: the policy knows none;"
                f" {did_you_mean(unknown[0], names)}it has {', '.join(names)}"
            )
        if missing := [name for name in names if name not in given]:
            raise ValueError(
                f"observations: {', '.join(missing)} missing: the policy takes {', '.join(names)}"
            )
        if given != names:
            raise ValueError(
                f"observations: their order is {', '.join(given)}, must be {', '.join(names)}:"
                " reorder the columns"
            )
        for (name, unit), one in zip(observations, self.observations, strict=True):
            if unit is not None and one["unit"] is not None and unit != one["unit"]:
                raise ValueError(
                    f"observation {name!r}: its unit is {unit}, must be {one['unit']}: convert it"
                )
        if rate is not None and abs(rate / self.rate - 1.0) > 0.01:
            raise ValueError(
                f"rate: observations come at {rate:.4g} Hz, must be {self.rate:.4g} Hz, at which"
                " the policy was trained: it knows no other"
            )


@dataclasses.dataclass(frozen=True)
class Contract(Interface):
    """What stands in the file."""

    agent: str
    """Who was trained."""
    actuators: dict[str, dict[str, Any]]
    """Motor, or pattern of motors -> its fields, None for an ideal one, and their `sha256`."""
    assumed: dict[str, Any]
    """The environment, as `EnvConfig.from_mapping` reads it: command, delays, quanta, joints, what was drawn."""
    controller: dict[str, Any]
    """What the C computes in, `real`, and the numbers of the `loop` behind the policy, None where it has none."""
    limits: dict[str, list[float | None]]
    """Observation -> least and most, beyond which the policy is not asked and the command is that for safety."""
    late: dict[str, Any]
    """What to do when no observation or command comes."""
    golden: dict[str, Any]
    """`observations` (n, k) of episodes and `actions` (n, m) or (n,) of the policy, and how far others may be off."""
    versions: dict[str, str]
    """Of what made it."""

    @classmethod
    def of(
        cls,
        policy: Policy,
        env: EnvConfig,
        agent: str,
        episodes: int = 5,
        seed: int = 0,
        limits: Mapping[str, float] | None = None,
        double: bool = False,
    ) -> "Contract":
        """What a policy assumes that was trained in an environment.

        Args:
            policy: as `codrl_mj.runs.policies.load_policy` returns it.
            env: what it was trained in.
            agent: the name of what trained it.
            episodes: how many are run for golden numbers, each to its end; as many more if they end
                too soon.
            seed: of the first of them.
            limits: observation -> largest size of it that is safe, in its unit; of an angle that is
                observed as `cos_NAME` and `sin_NAME` by its NAME, below pi.
            double: whether the C computes in double, not float.

        Raises:
            ValueError: the policy cannot be exported, `episodes` is below 1, or a limit is unknown
                or not positive.
        """
        network = network_of(policy)
        run = run_episodes(policy, env.make, episodes, seed)
        while sum(len(one.time) for one in run) < GOLDEN:  # some fail at once
            run += run_episodes(policy, env.make, episodes, seed + len(run))
        seen = np.concatenate([one.observation[:-1] for one in run])
        chosen = seen[np.unique(np.linspace(0, len(seen) - 1, GOLDEN).astype(int))]
        between = Interface.between(env)
        for place, entry in enumerate(between.observations):
            entry |= network.first_step(place)
            entry["seen"] = [float(seen[:, place].min()), float(seen[:, place].max())]
        acted = policy.predict(chosen, deterministic=True)[0]
        largest = max(1.0, float(np.abs(between.commands(acted)).max()))
        return cls(
            **vars(between),
            agent=agent,
            actuators={name: _told(mapping_of(one)) for name, one in env.driven.items()},
            assumed=json.loads(json.dumps(env.as_mapping())),
            controller={"real": "double" if double else "float", "loop": current_loop(env)},
            limits=_limits([one["name"] for one in between.observations], limits or {}),
            late={
                "after": LATE / between.rate,
                "unit": "s",
                "command": [0.0] * len(between.actions),
            },
            golden={
                "observations": chosen.tolist(),
                "actions": acted.tolist(),
                "tolerance": CLOSE * largest,
            },
            versions={
                "python": platform.python_version(),
                **{one: importlib.metadata.version(one) for one in _PACKAGES},
            },
        )

    @classmethod
    def read(cls, folder: Path) -> "Contract":
        """The contract of an exported folder, or a file itself.

        Raises:
            FileNotFoundError: there is none.
            ValueError: it is damaged, edited, or no contract.
        """
        path = folder / FILE if folder.is_dir() else folder
        content = read_json(path, "contract")
        if not isinstance(content, dict) or content.get("format") != FORMAT:
            raise ValueError(
                f"{path}: not a contract of this program: its format must be {FORMAT!r}"
            )
        entries = [field.name for field in dataclasses.fields(cls)]
        if missing := [name for name in entries if name not in content]:
            raise ValueError(f"{path}: has no {', '.join(missing)}: export it anew")
        return cls(**{name: content[name] for name in entries})

    def environment(self, trust: bool = False) -> EnvConfig:
        """Return the environment of the training; modules that it names are imported with `trust`, or refused."""
        with trusting(trust):
            return EnvConfig.from_mapping(self.assumed)

    def write(self, folder: Path) -> None:
        """Write `contract.json` into a folder, whole or not at all, with a digest of itself."""
        write_json(folder / FILE, with_digest({"format": FORMAT, **dataclasses.asdict(self)}))

    def within(self, observations: np.ndarray) -> np.ndarray:
        """Whether observations (N, k) are finite and within the limits, shape (N,)."""
        fine = np.isfinite(observations).all(axis=1)
        for place, one in enumerate(self.observations):
            least, most = self.limits.get(one["name"], (None, None))
            fine &= (least is None or observations[:, place] >= least) & (
                most is None or observations[:, place] <= most
            )
        return fine

    def admit_actuators(self, actuators: Mapping[str, Any]) -> None:
        """Refuse actuators that are not those of the training; by motor or pattern, each an `ActuatorModel`.

        Raises:
            ValueError: one differs; the message names the first number that does.
        """
        for name, mine in self.actuators.items():
            if name not in actuators:
                raise ValueError(
                    f"actuator {name!r}: missing: the policy was trained through {mine['fields']}"
                )
            theirs = _told(mapping_of(actuators[name]))
            if theirs["sha256"] != mine["sha256"]:
                found = differing(mine["fields"] or {}, theirs["fields"] or {})
                where, (wanted, given) = next(iter(found.items()), ("family", (None, None)))
                raise ValueError(
                    f"actuator {name!r}: {where} = {given}, must be {wanted}, through which the"
                    " policy was trained; evaluate it on yours, or train through that"
                )


def _limits(names: list[str], limits: Mapping[str, float]) -> dict[str, list[float | None]]:
    """Least and most of observations, by the largest size of each or of an angle."""
    angles = [name.removeprefix("cos_") for name in names if name.startswith("cos_")]
    check_names(limits, [*names, *angles], "limit")
    for name, most in limits.items():
        if not 0.0 < most < (np.pi if name in angles else np.inf):
            raise ValueError(
                f"limit {name} = {most:g}: must be > 0{' and < pi' if name in angles else ''}, and"
                " finite"
            )
    return {
        f"cos_{name}" if name in angles else name: (
            [float(np.cos(most)), None] if name in angles else [-most, most]
        )
        for name, most in limits.items()
    }


def _told(fields: Mapping[str, Any] | None) -> dict[str, Any]:
    digest = hashlib.sha256(json.dumps(fields, sort_keys=True).encode()).hexdigest()
    return {"fields": fields, "sha256": digest}
