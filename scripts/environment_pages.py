"""Writes docs/environments/: a page for each environment, from its task's docstring and its code, so they cannot drift.

`make docs` runs it; a test compares the pages with what it would write.
"""

import argparse
import dataclasses
import importlib
import inspect
import re
import sys
from pathlib import Path

import gymnasium
from PIL import Image

from codrl_mj.actuators import Drive
from codrl_mj.envs import ActuatedEnv
from codrl_mj.envs.config import EnvConfig
from codrl_mj.fields import field_docs
from codrl_mj.runs.files import writing
from codrl_mj.tasks import TASKS, named_actuator

FOLDER = Path(__file__).parent.parent / "docs" / "environments"


def _title(task_name: str) -> str:
    """What a page is called: the environment's id without our namespace."""
    return TASKS[task_name].env_id.removeprefix("codrl_mj/")


def _documentation(task_name: str) -> tuple[str, str]:
    """The first line of a task's documentation, and the rest."""
    documented = (importlib.import_module(f"codrl_mj.tasks.{task_name}").__doc__ or "").strip()
    summary, _, body = documented.partition("\n\n")
    return summary, body


def _space(space: object) -> str:
    """A space on one line, without numpy's padding."""
    return re.sub(r"\s+", " ", str(space)).replace("[ ", "[").replace(" ]", "]")


def common_arguments() -> str:
    """The arguments of every environment but `task`, as a table: name, default, meaning.

    Raises:
        ValueError: the signature of `ActuatedEnv` and the arguments that it documents differ.
    """
    documented = inspect.cleandoc(ActuatedEnv.__init__.__doc__ or "").partition("Args:\n")[2].partition("\n\n")[0]
    entries = re.findall(r"^    (\**\w+): (.*(?:\n {8}.*)*)", documented, re.MULTILINE)
    meanings = {name.lstrip("*"): " ".join(text.split()) for name, text in entries}
    parameters = {
        name: parameter
        for name, parameter in inspect.signature(ActuatedEnv.__init__).parameters.items()
        if name not in ("self", "task")
    }
    if meanings.keys() - {"task"} != parameters.keys():
        raise ValueError(f"ActuatedEnv documents {', '.join(meanings)} but takes {', '.join(parameters)}")
    defaults = {field.name: field.default for field in dataclasses.fields(EnvConfig)[1:] if field.name != "options"}
    meanings |= field_docs(EnvConfig)
    defaults |= {
        name: parameter.default
        for name, parameter in parameters.items()
        if name not in defaults and parameter.kind is not parameter.VAR_KEYWORD  # the tasks' own, which each page has
    }
    rows = [f"| `{name}` | `{default!r}` | {meanings[name]} |" for name, default in defaults.items()]
    return "| argument | default | meaning |\n| --- | --- | --- |\n" + "\n".join(rows)


def page(task_name: str) -> str:
    """The Markdown page of one environment."""
    task = TASKS[task_name]
    summary, body = _documentation(task_name)
    own = task.options()._asdict().items()
    facts = {
        "make it": f'`gymnasium.make("{task.env_id}")`, on the command line `{task_name}`',
        "rebuilds": f"Gymnasium's `{task.gymnasium_id}`" if task.gymnasium_id else "nothing of Gymnasium's",
        "model": f"`assets/{task.asset}`",
        "action space": f"`{_space(task.action_space)}`",
        "observation space": f"`{_space(task.observation_space)}`",
        "observation names": ", ".join(f"`{name}`" for name in task.observation_names),
        "state": ", ".join(task.state_names),
        "environment step": f"{task.step_duration:g} s",
        "integration steps in it": f"{task.motor_inner_steps} with a motor, {task.ideal_inner_steps} without",
        "integrators": ", ".join(f"`{name}`" for name in task.integrators),
        "options of its own": ", ".join(f"`{name}` (default {value})" for name, value in own) or "none",
        "time limit": f"{task.max_episode_steps} steps",
        "solved at": "not defined" if task.reward_threshold is None else f"a return of {task.reward_threshold:g}",
        f"`{task.default_actuator}` actuator": _actuator(task_name),
    }
    rows = "\n".join(f"| {name} | {value} |" for name, value in facts.items())
    return (
        f"# {_title(task_name)}\n\n{summary}\n\n![{_title(task_name)}]({task_name}.png)\n\n"
        f"| | |\n| --- | --- |\n{rows}\n\n{body}\n\n"
        f"## Arguments of every environment\n\n{common_arguments()}\n"
    )


def _actuator(task_name: str) -> str:
    """The numbers of a task's own actuator."""
    actuator = named_actuator("default", task_name)
    motor, loop = actuator.motor, actuator.controller
    constants = (
        f"R {motor.resistance:g} Ω, L {motor.inductance:g} H, kT {motor.torque_constant:g} N·m/A, "
        f"kE {motor.back_emf_constant:g} V·s/rad"
    )
    if isinstance(actuator, Drive):
        return (
            f"{constants}, rotor {motor.rotor_inertia:g} kg·m²; loop at {loop.sample_rate / 1e3:g} kHz, "
            f"{loop.max_current:g} A, {actuator.voltage_limit:g} V"
        )
    return (
        f"{constants}, arm {motor.arm_radius:g}; kP {loop.kp:g}, kI {loop.ki:g}, kD {loop.kd:g}, kFF {loop.kff:g}, "
        f"{loop.max_voltage:g} V"
    )


def index() -> str:
    """The Markdown page that lists the environments."""
    rows = "\n".join(
        f"| [{_title(name)}]({name}.md) | {_documentation(name)[0].partition(': ')[2]} |" for name in TASKS
    )
    return (
        f"# Environments\n\nWritten by `make docs` from the code; edit the docstrings in `codrl_mj/tasks/`.\n\n"
        f"| environment | task |\n| --- | --- |\n{rows}\n"
    )


def picture(task_name: str) -> Image.Image:
    """The task after a few random actions."""
    env = gymnasium.make(TASKS[task_name].env_id, render_mode="rgb_array", width=480, height=360, pretty=True)
    env.action_space.seed(1)
    env.reset(seed=1)
    for _ in range(8):
        env.step(env.action_space.sample())
    image = Image.fromarray(env.render())  # type: ignore[arg-type]
    env.close()
    return image


def pages() -> dict[str, str]:
    """Every page by its file name."""
    return {"README.md": index()} | {f"{name}.md": page(name) for name in TASKS}


def main() -> int:
    """Write every page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=FOLDER, help="folder for the pages")
    options = parser.parse_args()
    for name, text in pages().items():
        with writing(options.out / name) as temporary:
            temporary.write_text(text)
        print(f"wrote {options.out / name}")
    for name in TASKS:
        with writing(options.out / f"{name}.png") as temporary:
            picture(name).save(temporary, format="png", optimize=True)
        print(f"wrote {options.out / name}.png")
    return 0


if __name__ == "__main__":
    sys.exit(main())
