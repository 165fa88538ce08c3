"""Writes docs/environments/: a page for each environment, from its task's docstring and its code, so they cannot drift.

`make docs` runs it; a test compares the pages with what it would write.
"""

import argparse
import importlib
import sys
from pathlib import Path

from codrl_mj.files import writing
from codrl_mj.motor import named_actuator
from codrl_mj.registration import ENVIRONMENTS
from codrl_mj.tasks import TASKS

FOLDER = Path(__file__).parent.parent / "docs" / "environments"


def page(task_name: str) -> str:
    """The Markdown page of one environment."""
    task, registered = TASKS[task_name], ENVIRONMENTS[task_name]
    documented = (importlib.import_module(f"codrl_mj.tasks.{task_name}").__doc__ or "").strip()
    summary, _, body = documented.partition("\n\n")
    actuator = named_actuator("paper", task_name)
    assert actuator is not None
    motor, loop = actuator.motor, actuator.controller
    facts = {
        "make it": f'`gymnasium.make("{registered.env_id}")`, on the command line `{task_name}`',
        "rebuilds": f"Gymnasium's `{task.gymnasium_id}`",
        "model": f"`assets/{task.asset}`",
        "action space": f"`{task.action_space}`",
        "observation space": f"`{task.observation_space}`",
        "observation names": ", ".join(f"`{name}`" for name in task.observation_names),
        "state": ", ".join(task.state_names),
        "environment step": f"{task.step_duration:g} s",
        "integration steps in it": f"{task.motor_inner_steps} with a motor, 1 without",
        "integrators": ", ".join(f"`{name}`" for name in task.integrators),
        "options of its own": ", ".join(f"`{name}`" for name in task.options._fields) or "none",
        "time limit": f"{registered.max_episode_steps} steps",
        "`paper` actuator": f"R {motor.resistance:g} Ω, L {motor.inductance:g} H, kT {motor.torque_constant:g} N·m/A, "
        f"kE {motor.back_emf_constant:g} V·s/rad, arm {motor.arm_radius:g}; kP {loop.kp:g}, kI {loop.ki:g}, "
        f"kD {loop.kd:g}, kFF {loop.kff:g}, {loop.max_voltage:g} V",
    }
    rows = "\n".join(f"| {name} | {value} |" for name, value in facts.items())
    title = registered.env_id.removeprefix("codrl_mj/")
    return f"# {title}\n\n{summary}\n\n| | |\n| --- | --- |\n{rows}\n\n{body}\n"


def main() -> int:
    """Write every page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=FOLDER, help="folder for the pages")
    options = parser.parse_args()
    for task_name in TASKS:
        with writing(options.out / f"{task_name}.md") as temporary:
            temporary.write_text(page(task_name))
        print(f"wrote {options.out / f'{task_name}.md'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
