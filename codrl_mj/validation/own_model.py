"""The checks that apply to a user's own model, or a task's, with any number of our motors at either door."""

import copy
import dataclasses
from collections.abc import Iterator, Mapping
from pathlib import Path

import mujoco
import numpy as np

from codrl_mj.actuators import Actuator, ActuatorModel, Ideal, spectral_radius
from codrl_mj.physics import Plant, install_callbacks, motors
from codrl_mj.physics.mjcf import task_model
from codrl_mj.tasks import find_task, resolve_actuators
from codrl_mj.validation import execution
from codrl_mj.validation.compare import STAND_IN, actuators_of
from codrl_mj.validation.in_python import beside, entries
from codrl_mj.validation.rotors import Loop
from codrl_mj.validation.table import Case, Check, Oracle, Skipped, check

STEP_TOLERANCE = 1e-11
"""The compiled loop may fuse a multiplication with an addition: 1e-16 a step, which a slow loop adds up."""


def load(path: Path) -> mujoco.MjModel:
    """Compile an MJCF file; a FileNotFoundError or a ValueError where there is none that MuJoCo takes."""
    if not path.is_file():
        raise FileNotFoundError(f"no model at {path}")
    try:
        return mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        raise ValueError(f"{path}: MuJoCo cannot compile this model: {error}") from None


def prepare(model: mujoco.MjModel) -> mujoco.MjModel:
    """A copy of the model, our callbacks installed, that is left to diverge and not reset by the engine."""
    if not motors(model):
        raise ValueError(
            f"the model has no motor of codrl_mj among its {model.nactuator} actuators: put some in with "
            "codrl_mj.motorise"
        )
    subject = copy.copy(model)
    subject.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    install_callbacks(subject)
    return subject


UNKNOWN = {
    "dynamics": "no Gymnasium environment has these equations of motion",
    "trajectories": "no Gymnasium environment has these equations of motion",
    "convergence": "there is no second implementation of the mechanics to converge to",
    "energy": "the losses of joints, contacts and constraints are not modelled here",
}
"""Groups that need to know more of a model than its motors, and what."""


def skipped(model: mujoco.MjModel, name: str) -> list[Skipped]:
    """What does not apply to a model of which nothing but its motors is known."""
    ours = motors(model)
    foreign = [model.actuator(index).name or str(index) for index in range(model.nactuator) if index not in ours]
    found = [Skipped("all checks", reason, group, name) for group, reason in UNKNOWN.items()]
    if foreign:
        reason = "not motors of codrl_mj, which leaves them alone"
        found.append(Skipped(f"actuators {', '.join(foreign)}", reason, "motor", name))
    return found


BELOW_ONE = float(np.nextafter(1.0, 0.0))


@check("motor", Oracle("stable: {motor}", "the family's own bound", BELOW_ONE, "instability"))
def stable_actuator(actuator: ActuatorModel, timestep: float) -> Iterator[Case]:
    """What the family says of its parameters."""
    yield Case(actuator.instability(np.array([actuator.numbers]), timestep), f"at a step of {timestep:g} s")


@check("motor", Oracle("stable: {motor}", "the eigenvalues of the discrete closed loop", BELOW_ONE, "spectral radius"))
def stable_loop(actuator: Actuator, timestep: float) -> Iterator[Case]:
    """The spectral radius, beside what the family says, which is infinite from 1 on."""
    radius = spectral_radius(actuator, timestep)
    found = float(actuator.instability(np.array([actuator.numbers]), timestep)[0])
    yield Case(max(found, radius) if radius < 1.0 else radius, f"at a step of {timestep:g} s")


@check("motor", Oracle("steps: {motor}", "the same functions in plain Python at the recorded speed", STEP_TOLERANCE))
def motor_steps(actuator: ActuatorModel, ours: np.ndarray, oracle: np.ndarray) -> Iterator[Case]:
    """A motor in the engine against its own in plain Python, driven by the speed that the model itself reached.

    The Python motor starts at rest and is never corrected; states and signals are compared after every step, and so is
    the torque that the engine applied.
    """
    names = entries(actuator)
    yield Case(
        np.abs(ours - oracle) / np.maximum(1.0, np.abs(oracle)),
        lambda at: f"{names[at % len(names)]} at step {at // len(names) + 1}",
    )


def _idle(model: mujoco.MjModel, index: int, actuator: ActuatorModel) -> str:
    """Why a motor has no steps to look at; empty if it has."""
    group = int(model.actuator_group[index])
    if 0 <= group < mujoco.mjNGROUP and bool(model.opt.disableactuator >> group & 1):
        return "its actuator group is disabled: it never runs"
    return "it is ideal: there is nothing to step" if isinstance(actuator, Ideal) else ""


def motor_checks(model: mujoco.MjModel, name: str, quick: bool) -> Iterator[Check | Skipped]:
    """The motors of a model whose callbacks are installed: stable, in step with Python, and each loop alone."""
    ours = {at: (model.actuator(at).name or f"actuator {at}", actuator) for at, actuator in motors(model).items()}
    idle = {at: reason for at, (_, actuator) in ours.items() if (reason := _idle(model, at, actuator))}
    for at, reason in idle.items():
        yield Skipped(f"steps: {ours[at][0]}", reason, "motor", name)
    for motor, actuator in ours.values():
        if isinstance(actuator, Actuator):
            yield from stable_loop.of(name, motor=motor)(actuator, model.opt.timestep)
        else:
            yield from stable_actuator.of(name, motor=motor)(actuator, model.opt.timestep)
    controls = execution.commands(model, 200 if quick else 2000, seed=7)
    running = {at: actuator for at, (_, actuator) in ours.items() if at not in idle}
    for at, found in beside(model, running, controls).items():
        yield from motor_steps.of(name, motor=ours[at][0])(running[at], *found)
    yield from _alone(model.opt.timestep, dict(ours.values()), name, quick)


def checks(task_name: str, quick: bool = False) -> Iterator[Check | Skipped]:
    """The checks of a task's own motors, in its model."""
    task = find_task(task_name)
    if not task.paper:
        yield Skipped("the paper's actuators", f"it has none: the {STAND_IN} is in their place", "motor", task.name)
    actuators = actuators_of(task) if task.actuator == "ideal" else resolve_actuators("default", task)
    model = task_model(Plant(task, actuators, task.motor_inner_steps))
    install_callbacks(model)
    yield from motor_checks(model, task.name, quick)


def _alone(timestep: float, ours: Mapping[str, ActuatorModel], name: str, quick: bool) -> Iterator[Check | Skipped]:
    """Current loops, each on a rotor of its own, against python-control's discrete model of the loop."""
    from codrl_mj.validation.motor_loops import sampled_checks  # needs scipy and python-control

    loops = {}
    for motor, actuator in ours.items():
        if not isinstance(actuator, Actuator):
            yield Skipped(f"responses of {motor}", "it is no current loop: there is no oracle for it", "motor", name)
        elif spectral_radius(actuator, timestep) < 1.0:
            loops[motor] = Loop(actuator, timestep)
        else:
            yield Skipped(f"responses of {motor}", "its loop is unstable: it has none", "motor", name)
    for outcome in sampled_checks(loops, quick) if loops else ():
        yield dataclasses.replace(outcome, task=name)
