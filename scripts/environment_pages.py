"""Write docs/environments/: a page for each environment, from its docstring and code.

`make docs` runs it; a test compares the pages with its output, so they cannot drift apart.
"""

import argparse
import dataclasses
import importlib
import inspect
import re
import sys
from pathlib import Path

from codrl_mj.actuators import Drive
from codrl_mj.envs import ActuatedEnv
from codrl_mj.envs.config import EnvConfig, find_source
from codrl_mj.fields import field_docs
from codrl_mj.runs.files import atomic_write
from codrl_mj.tasks import TASKS, named_actuator
from page_pictures_tasks import SCENES

FOLDER = Path(__file__).parent.parent / "docs" / "environments"


def _title(task_name: str) -> str:
    """Return a page's title: the environment's id without our namespace."""
    return TASKS[task_name].env_id.removeprefix("codrl_mj/")


def _documentation(task_name: str) -> tuple[str, str]:
    """Return the first line of a task's documentation, and the rest."""
    documented = (importlib.import_module(f"codrl_mj.tasks.{task_name}").__doc__ or "").strip()
    summary, _, body = documented.partition("\n\n")
    return summary, body


def _space(space: object) -> str:
    """Format a space on one line, without numpy's padding."""
    return re.sub(r"\s+", " ", str(space)).replace("[ ", "[").replace(" ]", "]")


def common_arguments() -> str:
    """Return a table of all environments' arguments except `task`: name, default, meaning.

    Raises:
        ValueError: the signature of `ActuatedEnv` and the arguments that it documents differ.
    """
    documented = (
        inspect.cleandoc(ActuatedEnv.__init__.__doc__ or "")
        .partition("Args:\n")[2]
        .partition("\n\n")[0]
    )
    entries = re.findall(r"^    (\**\w+): (.*(?:\n {8}.*)*)", documented, re.MULTILINE)
    meanings = {name.lstrip("*"): " ".join(text.split()) for name, text in entries}
    parameters = {
        name: parameter
        for name, parameter in inspect.signature(ActuatedEnv.__init__).parameters.items()
        if name not in ("self", "task")
    }
    if meanings.keys() - {"task"} != parameters.keys():
        raise ValueError(
            f"ActuatedEnv documents {', '.join(meanings)} but takes {', '.join(parameters)}"
        )
    defaults = {field.name: field.default for field in dataclasses.fields(EnvConfig)[1:]}
    # The options of a task are on its own page.
    common = {*find_source("pendulum").fields} - {"options"}
    defaults = {name: default for name, default in defaults.items() if name in common}
    meanings |= field_docs(EnvConfig)
    defaults |= {
        name: parameter.default
        for name, parameter in parameters.items()
        if name not in defaults
        # Keyword arguments are the tasks' options.
        and parameter.kind is not parameter.VAR_KEYWORD
    }
    # The reference has the full texts; the table shows their first sentences.
    for name, text in meanings.items():
        first, stop, _ = text.partition(". ")
        meanings[name] = first + stop.strip()
    shown = {name: re.sub(r"\(.*\)$", "()", repr(default)) for name, default in defaults.items()}
    rows = [f"| `{name}` | `{default}` | {meanings[name]} |" for name, default in shown.items()]
    return "| argument | default | meaning |\n| --- | --- | --- |\n" + "\n".join(rows)


def page(task_name: str) -> str:
    """Return the Markdown page of an environment."""
    task = TASKS[task_name]
    summary, body = _documentation(task_name)
    description = summary.partition(": ")[2]
    title, options = _title(task_name), task.options()._asdict().items()
    facts = {
        "action space": f"`{_space(task.action_space)}`",
        "state": ", ".join(task.state_names),
        "environment step": f"{task.step_duration:g} s",
        "integration steps in it": (
            f"{task.motor_inner_steps} with a motor, {task.ideal_inner_steps} without"
        ),
        "integrators": ", ".join(f"`{name}`" for name in task.integrators),
        "options of its own": (
            ", ".join(f"`{name}` (default {value})" for name, value in options) or "none"
        ),
        "time limit": f"{task.max_episode_steps} steps",
        f"`{task.default_actuator}` actuator": _actuator(task_name),
    }
    if task.reward_threshold is not None:
        facts["solved at"] = f"a return of {task.reward_threshold:g}"
    rows = "\n".join(f"| {name} | {value} |" for name, value in facts.items())
    return (
        f"# {title}\n\n{description[0].upper()}{description[1:]}\n\n"
        f"![A policy on {title}; below it torque and voltage of the motor]({task_name}.webp)\n\n"
        f"```console\n$ codrl-mj train {task_name} {SCENES[task_name].flags}\n```\n\n"
        f"| | |\n| --- | --- |\n{rows}\n\n{body}\n"
    )


def _actuator(task_name: str) -> str:
    """Describe a task's default actuator by its numbers."""
    actuator = named_actuator("default", task_name)
    motor, loop = actuator.motor, actuator.controller
    constants = (
        f"R {motor.resistance:g} Ω, L {motor.inductance:g} H, kT {motor.torque_constant:g} N·m/A, "
        f"kE {motor.back_emf_constant:g} V·s/rad"
    )
    if isinstance(actuator, Drive):
        return (
            f"{constants}, rotor {motor.rotor_inertia:g} kg·m²; loop at {loop.sample_rate / 1e3:g}"
            f" kHz, {loop.max_current:g} A, {actuator.voltage_limit:g} V"
        )
    return (
        f"{constants}, arm {motor.arm_radius:g}; kP {loop.kp:g}, kI {loop.ki:g}, kD {loop.kd:g},"
        f" kFF {loop.kff:g}, {loop.max_voltage:g} V"
    )


def index() -> str:
    """Return the Markdown page that lists the environments."""
    rows = "\n".join(
        f"| [{_title(name)}]({name}.md) | {_documentation(name)[0].partition(': ')[2]} |"
        for name in TASKS
    )
    return (
        '# Environments\n\nChoose a task: `gymnasium.make("codrl_mj/Pendulum-v0")`, after `import'
        " codrl_mj`. All environments take [the same arguments](arguments.md).\n\n"
        f"| environment | task |\n| --- | --- |\n{rows}\n"
    )


def arguments() -> str:
    """Return the Markdown page on the arguments of all environments."""
    return (
        "# Arguments of every environment\n\nThese arguments select the actuator and configure the"
        ' simulation.\n\n```python\nimport codrl_mj\n\nenv = codrl_mj.make("cartpole",'
        ' actuator="weak", observe_actuator=True)\n```\n\n`gymnasium.make` takes the same'
        " arguments; on the command line they are flags: `--env.observe-actuator`. [The page of a"
        f" task](README.md) lists its own options.\n\n{common_arguments()}\n"
    )


def pages() -> dict[str, str]:
    """Return all pages by file name."""
    return {"README.md": index(), "arguments.md": arguments()} | {
        f"{name}.md": page(name) for name in TASKS
    }


def main() -> int:
    """Write all pages; scripts/page_pictures_tasks.py makes the films on them."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=FOLDER, help="folder for the pages")
    options = parser.parse_args()
    for name, text in pages().items():
        with atomic_write(options.out / name) as temporary:
            temporary.write_text(text)
        print(f"wrote {options.out / name}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
