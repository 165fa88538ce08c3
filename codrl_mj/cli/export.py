"""`codrl-mj export`."""

import dataclasses
from pathlib import Path
from typing import Annotated, Any

import tyro

from codrl_mj.cli.subject import Source


@dataclasses.dataclass(frozen=True)
class Export:
    """Take a trained policy out of the simulator: as ONNX, as C99, and contract.json with all that it assumes.

    The contract has names, units, order and range of observations and actions, rate, actuator, delays, what to do when
    late, and 200 observations of episodes with the policy's actions, to be computed again elsewhere (docs/deploy.md).

    Example: codrl-mj export runs/furuta-ppo-ideal-0 --out furuta
    """

    run_folder: Annotated[
        tyro.conf.Positional[Path],
        tyro.conf.arg(metavar="RUN", help="Run folder, or a folder with a policy alone (see --task)."),
    ]
    source: tyro.conf.OmitArgPrefixes[Source] = Source()
    out: Path = Path("exported")
    """Folder to write; it must not exist, or be empty."""
    episodes: int = 5
    """Episodes that are run for the contract's ranges and golden numbers."""
    seed: int = 0
    """Seed of the first of them."""
    float64: bool = False
    """Compute in double in the C, not in float."""
    limit: tuple[str, ...] = ()
    """Largest safe size of observations, as arm_velocity=30 arm=1.8: beyond, the command is that for safety. An angle
    that is observed as cos_arm and sin_arm is called arm."""
    board: str | None = None
    """What it is to fit: arduino-uno, arduino-due, nucleo-f446re, raspberry-pi-pico or teensy-4.1."""

    def run(self) -> int:
        """Write the folder, and say what is in it."""
        from codrl_mj.cli.terminal import print_table
        from codrl_mj.deploy import export, network_of

        subject = self.source.load(self.run_folder)
        agent = self.source.agent or type(subject.policy).__name__
        if subject.run is not None:
            from codrl_mj.training.folder import load_config

            agent = load_config(subject.run, self.source.trust).agent.known_as()
        given = self.out, self.episodes, self.seed, self.float64, self.board, dict(map(_limit, self.limit))
        contract = export(subject.policy, subject.env, agent, *given)
        rows = [
            (side, one["name"], one.get("unit") or "?", _bounds(one))
            for side, several in (("observation", contract.observations), ("action", contract.actions))
            for one in several
        ]
        print_table(f"{contract.task}, {agent}, {contract.rate:g} Hz", ("", "name", "unit", "range"), rows)
        weights = network_of(subject.policy).size
        if contract.controller["loop"] is None and contract.actuators:
            print("no current loop: the motors differ, have none, or are commanded otherwise")
        written = f"wrote {self.out}: policy.onnx, contract.json, controller.c ({weights} numbers)"
        print(f"{written}; try: codrl-mj board test {self.out}")
        return 0


def _limit(text: str) -> tuple[str, float]:
    name, _, most = text.partition("=")
    try:
        return name, float(most)
    except ValueError:
        raise ValueError(f"--limit {text}: must be NAME=NUMBER, such as arm_velocity=30") from None


def _bounds(entry: dict[str, Any]) -> str:
    if "levels" in entry:
        return f"one of {', '.join(f'{level:g}' for level in entry['levels'])}"
    least, most = entry.get("least"), entry.get("most")
    return "any" if least is None or most is None else f"{least:g} to {most:g}"
