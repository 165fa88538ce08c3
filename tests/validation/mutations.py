"""Ways to make the simulation of a task wrong, for the tests of the checks that must notice."""

import mujoco

from codrl_mj.actuators import DCMotorActuator, parameters_type
from codrl_mj.engine.families import USER_HEADER_SIZE
from codrl_mj.physics import MujocoPhysics


def wrong_model(monkeypatch, change):
    """Every task's MuJoCo model has the change made to it once it was accepted: `change(model)`."""
    make = MujocoPhysics.__init__

    def make_wrong(self, *arguments, **options):
        make(self, *arguments, **options)
        change(self.model)

    monkeypatch.setattr(MujocoPhysics, "__init__", make_wrong)


def entry(parameter):
    """Where a current loop's parameter is in the user data of its actuator."""
    return USER_HEADER_SIZE + parameters_type(DCMotorActuator)._fields.index(parameter)


def scaled_motor(parameter, factor):
    """A change that scales one parameter of the motor, where there is one."""

    def change(model):
        if model.nuser_actuator:
            model.actuator_user[:, entry(parameter)] *= factor

    return change


def scaled(field, factor, at=slice(None)):
    """A change that scales an array of the model, or a part of it."""

    def change(model):
        getattr(model, field)[at] *= factor

    return change


def euler(model):
    """Another integrator than the task's."""
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER


def rusty(model):
    """Friction that nobody asked for."""
    model.dof_damping[:] = 0.05


def late_force(monkeypatch):
    """MuJoCo gets every command one environment step late."""
    step, reset = MujocoPhysics.step, MujocoPhysics.reset

    def late(self, desired_force):
        force, self.waiting = self.waiting, desired_force
        return step(self, force)

    def forget(self, *arguments):
        self.waiting = 0.0
        reset(self, *arguments)

    monkeypatch.setattr(MujocoPhysics, "step", late)
    monkeypatch.setattr(MujocoPhysics, "reset", forget)


def failed(checks):
    """Names of the checks that failed."""
    return {check.name for check in checks if not check.passed}


KNOWN = {}
"""What was computed once."""


def once(function, faulty):
    """The function, which computes what it is asked for again once only, unless its first argument is the faulty."""

    def made(first, *others):
        key = function.__name__, repr((first, *(one for one in others if not callable(one))))
        if first is faulty or key not in KNOWN:
            KNOWN[key] = function(first, *others)
        return KNOWN[key]

    return made
