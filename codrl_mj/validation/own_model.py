"""The checks that apply to a user's own model with any number of our motors."""

import copy
import dataclasses
from collections.abc import Callable, Iterator
from pathlib import Path

import mujoco
import numpy as np

from codrl_mj.motor import Actuator, advance, spectral_radius, to_vector
from codrl_mj.physics import install_callbacks, motors
from codrl_mj.validation import execution
from codrl_mj.validation.compare import Worst
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
            f"the model has no motor of codrl_mj among its {model.nactuator} actuators: put one in with "
            "codrl_mj.set_actuator, or write its user data in the MJCF as the package's own models do"
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
        reason = "not motors of codrl_mj: the callbacks leave them alone"
        found.append(Skipped(f"actuators {', '.join(foreign)}", reason, "motor", name))
    return found


def _names(model: mujoco.MjModel) -> dict[int, tuple[str, Actuator]]:
    return {
        index: (model.actuator(index).name or f"actuator {index}", actuator)
        for index, actuator in motors(model).items()
    }


def stability(model: mujoco.MjModel, name: str) -> Iterator[Check]:
    """The spectral radius of each motor's current loop at the model's timestep, which must be below 1."""
    timestep = model.opt.timestep
    below_one = float(np.nextafter(1.0, 0.0))
    for motor, actuator in _names(model).values():
        radius = spectral_radius(actuator, timestep)
        where = f"at a step of {timestep:g} s"
        oracle = "the eigenvalues of the discrete closed loop"
        yield Check(f"stable: {motor}", oracle, 1, radius, below_one, where, "motor", name, "spectral radius")


def motor_steps(model: mujoco.MjModel, name: str, steps: int) -> Iterator[Check]:
    """Each motor in the engine against the loop in plain Python, driven by the speed that the model itself reached.

    The Python loop starts at rest and is never corrected; current, integral, error and voltage are compared after every
    step, and so is the torque that the engine applied.
    """
    data = mujoco.MjData(model)
    named = _names(model)
    loops = dict.fromkeys(named, (0.0, 0.0, 0.0))
    worst = {index: Worst() for index in named}
    for step, control in enumerate(execution.commands(model, steps, seed=7)):
        data.ctrl[:] = control
        before = copy.copy(data)
        mujoco.mj_forward(model, before)  # the speed that the callback is about to see, and the force it makes
        mujoco.mj_step(model, data)
        for index, (_, actuator) in named.items():
            if _disabled(model, index):
                continue
            output = model.actuator_outadr[index]
            speed, desired = float(before.actuator_velocity[output]), _clamped(model, index, control)
            *loop, voltage = advance(to_vector(actuator), model.opt.timestep, *loops[index], desired, speed)
            loops[index] = tuple(loop)  # type: ignore[assignment]
            act = data.act[model.actuator_actadr[index] :]
            ours = [*act[4:8], before.actuator_force[output]]
            oracle = [*loop, voltage, _limited(model, index, actuator.motor.torque_constant * loop[0])]
            entries = ("current [A]", "integral [A*s]", "error [A]", "voltage [V]", "torque [N*m]")
            for entry, here, there in zip(entries, ours, oracle, strict=True):
                worst[index].see(abs(here - there) / max(1.0, abs(there)), f"{entry} at step {step + 1}")
    for index, (motor, _) in named.items():
        if not _disabled(model, index):
            found = worst[index]
            oracle_name = "the loop in plain Python at the recorded speed"
            yield Check(
                f"steps: {motor}", oracle_name, 5 * steps, found.value, STEP_TOLERANCE, found.where, "motor", name
            )


def _disabled(model: mujoco.MjModel, index: int) -> bool:
    group = int(model.actuator_group[index])
    return 0 <= group < mujoco.mjNGROUP and bool(model.opt.disableactuator >> group & 1)


def _clamped(model: mujoco.MjModel, index: int, control: np.ndarray) -> float:
    address = model.actuator_ctrladr[index]
    low, high = model.actuator_ctrlrange[address] if model.actuator_ctrllimited[address] else (-np.inf, np.inf)
    return float(np.clip(control[address], low, high))


def _limited(model: mujoco.MjModel, index: int, torque: float) -> float:
    if not model.actuator_forcelimited[model.actuator_outadr[index]]:
        return torque
    return float(np.clip(torque, *model.actuator_forcerange[model.actuator_outadr[index]]))


def _motor(model: mujoco.MjModel, name: str, quick: bool) -> Iterator[Check | Skipped]:
    for index, (motor, _) in _names(model).items():
        if _disabled(model, index):
            yield Skipped(f"steps: {motor}", "its actuator group is disabled: it never runs", "motor", name)
    yield from stability(model, name)
    yield from motor_steps(model, name, 200 if quick else 2000)
    yield from _alone(model, name, quick)


def _alone(model: mujoco.MjModel, name: str, quick: bool) -> Iterator[Check | Skipped]:
    """The model's motors, each on a rotor of its own, against python-control's discrete model of the loop."""
    from codrl_mj.validation.motor_loops import Loop
    from codrl_mj.validation.motor_sampled import sampled_checks  # needs scipy and python-control

    loops = {}
    for motor, actuator in _names(model).values():
        if spectral_radius(actuator, model.opt.timestep) < 1.0:
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
