"""Faults in the simulation of a task, for tests of the checks that must detect them."""

import mujoco

from codrl_mj.actuators import DCMotorActuator, parameters_type
from codrl_mj.engine.families import USER_HEADER_SIZE
from codrl_mj.physics import MujocoPhysics


def wrong_model(monkeypatch, change):
    """Apply `change(model)` to every task's MuJoCo model after its construction."""
    make = MujocoPhysics.__init__

    def make_wrong(self, *arguments, **options):
        make(self, *arguments, **options)
        change(self.model)

    monkeypatch.setattr(MujocoPhysics, "__init__", make_wrong)


def entry(parameter):
    """Return the index of a current loop's parameter in the user data of its actuator."""
    return USER_HEADER_SIZE + parameters_type(DCMotorActuator)._fields.index(parameter)


def scaled_motor(parameter, factor):
    """Return a change that scales one parameter of the motor, if the model has a motor."""

    def change(model):
        if model.nuser_actuator:
            model.actuator_user[:, entry(parameter)] *= factor

    return change


def scaled(field, factor, index=slice(None)):
    """Return a change that scales an array of the model, or a part of it."""

    def change(model):
        getattr(model, field)[index] *= factor

    return change


def euler(model):
    """Replace the task's integrator by Euler."""
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER


def rusty(model):
    """Add damping to all joints."""
    model.dof_damping[:] = 0.05


def late_force(monkeypatch):
    """Give every command to MuJoCo one environment step late."""
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
    """Return the names of the checks that failed."""
    return {check.name for check in checks if not check.passed}


CACHE = {}
"""Results of the functions of `once`."""


def once(function, faulty):
    """Return the function with a cache, which is not used if its first argument is `faulty`."""

    def cached(first, *others):
        # Functions have no stable representation, so they are left out of the key.
        key = (
            function.__name__,
            repr((first, *(argument for argument in others if not callable(argument)))),
        )
        if first is faulty or key not in CACHE:
            CACHE[key] = function(first, *others)
        return CACHE[key]

    return cached
