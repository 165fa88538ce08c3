"""The checks that apply to a user's own model, or a task's, with any number of our motors at either door."""

import copy
import dataclasses
from collections.abc import Callable, Iterator
from pathlib import Path

import mujoco
import numpy as np

from codrl_mj.actuators import Actuator, ActuatorModel, Ideal, spectral_radius
from codrl_mj.physics import install_callbacks, motors
from codrl_mj.physics.mjcf import task_model
from codrl_mj.tasks import find_task, resolve_actuators
from codrl_mj.validation import execution
from codrl_mj.validation.compare import STAND_IN, Worst, actuators_of
from codrl_mj.validation.in_python import beside, entries
from codrl_mj.validation.outcome import Check, Skipped

STEP_TOLERANCE = 1e-11
"""The compiled loop may fuse a multiplication with an addition: 1e-16 a step, which a slow loop adds up."""


def load(path: Path) -> mujoco.MjModel:
    """Compile an MJCF file.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: MuJoCo cannot compile it.
    """
    if not path.is_file():
        raise FileNotFoundError(f"no model at {path}")
    try:
        return mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        raise ValueError(f"{path}: MuJoCo cannot compile this model: {error}") from None


def prepare(model: mujoco.MjModel) -> mujoco.MjModel:
    """A copy of the model that is left to diverge instead of being reset by the engine, with our callbacks installed.

    Raises:
        ValueError: the model has no motor of ours, or one that is not as it should be.
    """
    if not motors(model):
        raise ValueError(
            f"the model has no motor of codrl_mj among its {model.nactuator} actuators: put some in with "
            "codrl_mj.motorise"
        )
    subject = copy.copy(model)
    subject.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    install_callbacks(subject)
    return subject


def skipped(model: mujoco.MjModel, name: str) -> list[Skipped]:
    """What does not apply to a model of which nothing but its motors is known."""
    ours = motors(model)
    foreign = [model.actuator(index).name or str(index) for index in range(model.nactuator) if index not in ours]
    found = [
        Skipped("all checks", "no Gymnasium environment has these equations of motion", "dynamics", name),
        Skipped("all checks", "no Gymnasium environment has these equations of motion", "trajectories", name),
        Skipped("all checks", "there is no second implementation of the mechanics to converge to", "convergence", name),
        Skipped("all checks", "the losses of joints, contacts and constraints are not modelled here", "energy", name),
    ]
    if foreign:
        reason = "not motors of codrl_mj, which leaves them alone"
        found.append(Skipped(f"actuators {', '.join(foreign)}", reason, "motor", name))
    return found


def _names(model: mujoco.MjModel) -> dict[int, tuple[str, ActuatorModel]]:
    return {
        index: (model.actuator(index).name or f"actuator {index}", actuator)
        for index, actuator in motors(model).items()
    }


def stability(model: mujoco.MjModel, name: str) -> Iterator[Check]:
    """How unstable each motor is at the model's timestep: below 1; of a current loop it is the spectral radius."""
    timestep = model.opt.timestep
    below_one = float(np.nextafter(1.0, 0.0))
    for motor, actuator in _names(model).values():
        found = float(actuator.instability(np.array([actuator.numbers]), timestep)[0])
        oracle, unit = "the family's own bound", "instability"
        if isinstance(actuator, Actuator):
            radius = spectral_radius(actuator, timestep)
            oracle, unit = "the eigenvalues of the discrete closed loop", "spectral radius"
            found = max(found, radius) if radius < 1.0 else radius  # the family's own is infinite there
        where = f"at a step of {timestep:g} s"
        yield Check(f"stable: {motor}", oracle, 1, found, below_one, where, "motor", name, unit)


def motor_steps(model: mujoco.MjModel, name: str, steps: int) -> Iterator[Check]:
    """Each motor in the engine against its own in plain Python, driven by the speed that the model itself reached.

    The Python motor starts at rest and is never corrected; states and signals are compared after every step, and so is
    the torque that the engine applied.
    """
    named = {index: found for index, found in _names(model).items() if not _idle(model, index, found[1])}
    actuators = {index: actuator for index, (_, actuator) in named.items()}
    for index, (ours, oracle) in beside(model, actuators, execution.commands(model, steps, seed=7)).items():
        gaps = np.abs(ours - oracle) / np.maximum(1.0, np.abs(oracle))
        step, entry = np.unravel_index(np.argmax(np.where(np.isnan(gaps), np.inf, gaps)), gaps.shape)
        worst = Worst()
        worst.see(gaps[step, entry], f"{entries(actuators[index])[entry]} at step {step + 1}")
        oracle_name = "the same functions in plain Python at the recorded speed"
        yield Check(
            f"steps: {named[index][0]}",
            *(oracle_name, gaps.size, worst.value, STEP_TOLERANCE, worst.where, "motor", name),
        )


def _idle(model: mujoco.MjModel, index: int, actuator: ActuatorModel) -> str:
    """Why a motor has no steps to look at; empty if it has."""
    group = int(model.actuator_group[index])
    if 0 <= group < mujoco.mjNGROUP and bool(model.opt.disableactuator >> group & 1):
        return "its actuator group is disabled: it never runs"
    return "it is ideal: there is nothing to step" if isinstance(actuator, Ideal) else ""


def _motor(model: mujoco.MjModel, name: str, quick: bool) -> Iterator[Check | Skipped]:
    for index, (motor, actuator) in _names(model).items():
        if reason := _idle(model, index, actuator):
            yield Skipped(f"steps: {motor}", reason, "motor", name)
    yield from stability(model, name)
    yield from motor_steps(model, name, 200 if quick else 2000)
    yield from _alone(model, name, quick)


def checks(task_name: str, quick: bool = False) -> Iterator[Check | Skipped]:
    """The checks of a task's own motors, in its model.

    Args:
        task_name: the task.
        quick: fewer steps.
    """
    task = find_task(task_name)
    if not task.paper:
        yield Skipped("the paper's actuators", f"it has none: the {STAND_IN} is in their place", "motor", task.name)
    actuators = actuators_of(task) if task.actuator == "ideal" else resolve_actuators("default", task)
    model = task_model(task, actuators, task.step_duration / task.motor_inner_steps)
    install_callbacks(model)
    yield from _motor(model, task.name, quick)


def _alone(model: mujoco.MjModel, name: str, quick: bool) -> Iterator[Check | Skipped]:
    """The model's current loops, each on a rotor of its own, against python-control's discrete model of the loop."""
    from codrl_mj.validation.motor_loops import Loop
    from codrl_mj.validation.motor_sampled import sampled_checks  # needs scipy and python-control

    loops = {}
    for motor, actuator in _names(model).values():
        if not isinstance(actuator, Actuator):
            yield Skipped(f"responses of {motor}", "it is no current loop: there is no oracle for it", "motor", name)
        elif spectral_radius(actuator, model.opt.timestep) < 1.0:
            loops[motor] = Loop(actuator, model.opt.timestep)
        else:
            yield Skipped(f"responses of {motor}", "its loop is unstable: it has none", "motor", name)
    for check in sampled_checks(loops, quick) if loops else ():
        yield dataclasses.replace(check, task=name)


def _execution(model: mujoco.MjModel, name: str, quick: bool) -> Iterator[Check | Skipped]:
    yield from execution.model_checks(model, name, quick, execution.FULL_STATE)


PARTS: dict[str, Callable[[mujoco.MjModel, str, bool], Iterator[Check | Skipped]]] = {
    "motor": _motor,
    "execution": _execution,
}
"""The groups that apply."""
