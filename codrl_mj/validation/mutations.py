"""The certificate put to the test: faults that somebody could have made, each of which must fail a named check.

A fault is made in a model, in the package's own source text (an edit, compiled anew), or in how a
simulation is driven, and is undone when the `with` block ends.
"""

import contextlib
import dataclasses
import inspect
import math
import sys
import types
import warnings
from collections.abc import Callable, Iterator, Sequence
from functools import cache, partial
from typing import Any
from unittest import mock

import mujoco
import numpy as np

from codrl_mj import engine
from codrl_mj.actuators import ActuatorModel, current_loop, drive
from codrl_mj.engine import control
from codrl_mj.engine.families import SLOT, replaced
from codrl_mj.engine.hill import GRAVITY
from codrl_mj.physics import MujocoPhysics, compiled_task, mjcf
from codrl_mj.physics.variation import bare_model
from codrl_mj.tasks import OURS, find_task
from codrl_mj.validation.certificate import (
    WITHOUT_TASK,
    Certificate,
    Progress,
    ignore_progress,
    validate,
)
from codrl_mj.validation.table import Check

Fault = contextlib.AbstractContextManager[object]


@contextlib.contextmanager
def _everywhere(name: str, original: Any, wrong: Any) -> Iterator[None]:
    """Replace `original` by `wrong` in every module of the package that knows it as `name`."""
    modules = [module for key, module in sys.modules.items() if key.startswith("codrl_mj")]
    with contextlib.ExitStack() as stack:
        for module in modules:
            if getattr(module, name, None) is original:
                stack.enter_context(mock.patch.object(module, name, wrong))
        yield


# -- in a model ---------------------------------------------------------------------------------------------


Part = tuple[str, int | tuple[int, int] | None, float]
"""(array of a model or its options, where in it, factor); of a plain number the place is None."""


@contextlib.contextmanager
def wrong_model(*parts: Part) -> Iterator[None]:
    """Every task's model is compiled with these parts of it scaled, those that it has."""
    build = mjcf.task_model

    def build_wrong(*arguments: Any, **options: Any) -> mujoco.MjModel:
        model = build(*arguments, **options)
        for field, at, factor in parts:
            owner = model.opt if hasattr(model.opt, field) else model
            if at is None:
                setattr(owner, field, getattr(owner, field) * factor)
            elif getattr(owner, field).size:
                getattr(owner, field)[at] *= factor
        return model

    bare_model.cache_clear()  # what is kept of right models, and of wrong ones after it
    try:
        with _everywhere("task_model", build, build_wrong):
            yield
    finally:
        bare_model.cache_clear()


# -- in the source text -------------------------------------------------------------------------------------

Edit = tuple[str, str]
"""(text that occurs once, text to put there)."""


def edited(module: types.ModuleType, edits: Sequence[Edit]) -> types.ModuleType:
    """A module made anew from another's source text, with the edits made, each of which must occur exactly once.

    Otherwise it is a ValueError: the source has changed, and the mutation must follow.
    """
    source = inspect.getsource(module)
    for old, new in edits:
        if source.count(old) != 1:
            raise ValueError(
                f"{module.__name__}: {old!r} occurs {source.count(old)} times, must occur once"
            )
        source = source.replace(old, new)
    wrong = types.ModuleType(module.__name__)
    exec(compile(source, f"<mutation of {module.__name__}>", "exec"), vars(wrong))
    return wrong


_HIDDEN = np.zeros(64)
"""Memory that no simulation owns, one number for each actuator of a model."""


@cache
def _wrong_callbacks(edits: tuple[Edit, ...]) -> Callable[[], Any]:
    wrong = edited(control, edits)
    wrong.HIDDEN = _HIDDEN.ctypes.data  # type: ignore[attr-defined]
    return wrong.compiled_motors


@contextlib.contextmanager
def wrong_callback(*edits: Edit) -> Iterator[None]:
    """MuJoCo runs a callback that was compiled from edited source."""
    names, _, remedy = control._PARTS["motor"]
    engine.uninstall()
    with mock.patch.dict(control._PARTS, motor=(names, _wrong_callbacks(edits), remedy)):
        try:
            yield
        finally:
            engine.uninstall()


@cache
def _wrong_families(
    module: types.ModuleType, edits: tuple[Edit, ...]
) -> tuple[type[ActuatorModel], ...]:
    """The families of a module, made from its edited source."""
    wrong = vars(edited(module, edits)).values()
    return tuple(
        kind
        for kind in wrong
        if isinstance(kind, type)
        and kind.__module__ == module.__name__
        and issubclass(kind, ActuatorModel)
    )


@contextlib.contextmanager
def wrong_loop(
    *edits: Edit, module: types.ModuleType = current_loop, everywhere: bool = False
) -> Iterator[None]:
    """The callback runs a loop that was compiled from edited source; in Python it stays what it is.

    With `everywhere` the plain-Python loop shares the fault: comparing the two cannot show it.
    """
    with contextlib.ExitStack() as stack:
        for family in _wrong_families(module, edits):
            right = getattr(module, family.__name__)
            stack.enter_context(replaced(right, family))
            if everywhere:
                stack.enter_context(mock.patch.object(right, "advance", vars(family)["advance"]))
        yield


_BACK_EMF: Edit = ("voltage - back_emf -", "voltage + back_emf -")
_GAINS: Edit = (
    "parameters.kp * error + parameters.ki * integral",
    "parameters.ki * error + parameters.kp * integral",
)
_RESISTANCE: Edit = (
    "- parameters.resistance * current",
    "- 1.01 * parameters.resistance * current",
)
_VOLTAGE_LIMIT: Edit = (
    "voltage = min(max(voltage, -",
    "voltage = 0.99 * min(max(voltage / 0.99, -",
)
_WARM_WINDING: Edit = (
    "parameters, resistance, timestep, samples",
    "parameters, 1.01 * resistance, timestep, samples",
)
_COMMIT = "                commit_slot(number, slot, time)\n"
_LATE_FORCE: tuple[Edit, ...] = (
    (
        _COMMIT,
        (
            f"                f64(HIDDEN)[actuator] = f64(slot)[2]\n{_COMMIT}"
            "            if time == 0.0:\n                f64(HIDDEN)[actuator] = 0.0\n"
        ),
    ),
    ("return f64(_slot_of(model, data, actuator))[2]", "return f64(HIDDEN)[actuator]"),
)
_EVERY_PASS: Edit = ("if time != f64(slot)[0]:", "if True:")
_EVERY_STAGE: Edit = ("if DATA.pbase(data) != 0:", "if False:")
_ADVANCED = "if size_of(number, INERTIA) else math.inf,\n            )\n"
_CANDIDATE = SLOT + len(current_loop.State._fields)
_SHARED_CURRENT: tuple[Edit, ...] = (
    (_COMMIT, f"{_COMMIT}                f64(slot)[{SLOT}] = f64(HIDDEN)[0]\n"),
    (_ADVANCED, f"{_ADVANCED}            f64(HIDDEN)[0] = f64(slot)[{_CANDIDATE}]\n"),
)


# -- in how a simulation is driven --------------------------------------------------------------------------


_STEP, _MAKE, _RESET = MujocoPhysics.step, MujocoPhysics.__init__, MujocoPhysics.reset


def _late(self: Any, desired_force: float) -> Any:
    force, self.waiting = getattr(self, "waiting", 0.0), desired_force
    return _STEP(self, force)


def _explicit(self: Any, plant: Any) -> None:
    other = "semi-implicit" if plant.integrator == "euler" else "euler"
    _MAKE(self, dataclasses.replace(plant, integrator=other))


def _warm(self: Any, state: np.ndarray, key: float = 0.0) -> None:
    motor = self.data.act.copy()
    _RESET(self, state, key)
    self.data.act[:] = motor


# -- the list -----------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Mutation:
    """A fault on purpose."""

    name: str
    """What is wrong."""
    apply: Callable[[], Fault]
    """Makes it, for the length of a `with` block."""
    groups: tuple[str, ...]
    """The groups of checks that it is shown to."""
    tasks: tuple[str, ...] = tuple(task.name for task in OURS)
    """The tasks in which it is a fault."""


_PHYSICS = ("dynamics", "trajectories")
_MECHANICS = (*_PHYSICS, "convergence", "energy")
_LOOP = ("trajectories", "motor")
_UNEQUAL_GAINS = tuple(
    task.name for task in OURS if task.paper[0].controller.kp != task.paper[0].controller.ki
)
_BOUNDED = tuple(task.name for task in OURS if task.constrain is not None)
_RUNGE_KUTTA = tuple(task.name for task in OURS if "rk4" in task.integrators)
_TURNING = ("pendulum", "cartpole", "acrobot")
"""Where back-EMF counts: gains that follow the winding hide it from anything else, and the cars'
motors hardly turn (a difference of 3e-10, where 1e-9 is allowed).
"""


MUTATIONS: tuple[Mutation, ...] = (
    Mutation("a mass off by 0.1 %", partial(wrong_model, ("body_mass", -1, 1.001)), _MECHANICS),
    Mutation(
        "gravity, or the hill, off by 0.1 %",
        partial(wrong_model, ("gravity", 2, 1.001), ("jnt_user", (0, GRAVITY), 1.001)),
        _PHYSICS,
    ),
    Mutation(
        "a gear off by 1 %", partial(wrong_model, ("actuator_gear", (0, 0), 1.01)), _MECHANICS
    ),
    Mutation(
        "a time step off by 0.1 %", partial(wrong_model, ("timestep", None, 1.001)), _MECHANICS
    ),
    Mutation(
        "a wrong clip: the force limit 1 % low",
        partial(wrong_model, ("actuator_ctrlrange", 0, 0.99)),
        _PHYSICS,
    ),
    Mutation(
        "a wrong clip: the voltage limit 1 % low, in the callback",
        partial(wrong_loop, _VOLTAGE_LIMIT),
        _LOOP,
    ),
    Mutation(
        "a winding resistance off by 1 %, in the callback",
        partial(wrong_loop, _RESISTANCE),
        (*_LOOP, "energy"),
    ),
    Mutation(
        "the sign of the back-EMF, in the callback",
        partial(wrong_loop, _BACK_EMF),
        (*_LOOP, "energy"),
    ),
    Mutation(
        "the sign of the back-EMF, everywhere",
        partial(wrong_loop, _BACK_EMF, everywhere=True),
        ("motor", "energy"),
    ),
    Mutation(
        "kp and ki swapped, in the callback", partial(wrong_loop, _GAINS), _LOOP, _UNEQUAL_GAINS
    ),
    Mutation(
        "kp and ki swapped, everywhere",
        partial(wrong_loop, _GAINS, everywhere=True),
        ("motor", "convergence"),
    ),
    Mutation(
        "a drive's winding off by 1 %, its gains with it",
        partial(wrong_loop, _WARM_WINDING, module=drive),
        _LOOP,
        _TURNING,
    ),
    Mutation(
        "a force one step late",
        partial(wrong_callback, *_LATE_FORCE),
        (*_LOOP, "convergence", "energy"),
    ),
    Mutation(
        "a stale command",
        partial(mock.patch.object, MujocoPhysics, "step", _late),
        (*_PHYSICS, "convergence"),
    ),
    Mutation(
        "bounds that are not kept",
        lambda: _everywhere(
            "compiled_constrain", compiled_task.compiled_constrain, lambda *_, **__: None
        ),
        _PHYSICS,
        _BOUNDED,
    ),
    Mutation(
        "the other Euler integrator",
        partial(mock.patch.object, MujocoPhysics, "__init__", _explicit),
        _PHYSICS,
    ),
    Mutation(
        "a motor that runs in every Runge-Kutta stage",
        partial(wrong_callback, _EVERY_STAGE),
        ("trajectories",),
        _RUNGE_KUTTA,
    ),
    Mutation(
        "a motor that runs in every forward pass",
        partial(wrong_callback, _EVERY_PASS),
        ("execution",),
    ),
    Mutation(
        "a current that simulations share",
        partial(wrong_callback, *_SHARED_CURRENT),
        ("execution",),
    ),
    Mutation(
        "a reset that leaves the motor running",
        partial(mock.patch.object, MujocoPhysics, "reset", _warm),
        ("execution",),
    ),
)
"""Every fault, and which groups are shown it."""


@dataclasses.dataclass(frozen=True)
class Caught:
    """What a mutation did to the certificate."""

    mutation: str
    """Its name."""
    task: str
    """The task it was made in; empty for checks that need none."""
    failed: tuple[Check, ...]
    """The checks that failed."""
    made: int
    """How many checks it was shown to."""

    @property
    def clearest(self) -> Check | None:
        """The failed check that is farthest beyond its tolerance, a NaN being infinitely far; None if none failed."""
        return max(self.failed, key=lambda check: check.beyond, default=None)


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """A fault may well overflow: that is what its checks are to say, and no warning besides."""
    handler = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda _: None)  # its own prints and writes a file
    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore", RuntimeWarning)
            yield
    finally:
        mujoco.set_mju_user_warning(handler)


def faulty(tasks: str | Sequence[str] | None = None) -> list[str]:
    """The names of the tasks that faults are made in, all that there are or those given, which must be ours."""
    names = [tasks] if isinstance(tasks, str) else list(tasks or Mutation.tasks)
    for name in names:
        if find_task(name) not in OURS:
            raise ValueError(
                f"task {name!r}: faults are made in these alone: {', '.join(Mutation.tasks)}"
            )
    return names


def try_mutations(
    tasks: str | Sequence[str] | None = None,
    mutations: Sequence[Mutation] = MUTATIONS,
    on_part: Progress = ignore_progress,
) -> list[Caught]:
    """Make each fault in turn and see which checks of the quick certificate fail.

    Args:
        tasks: a task of ours, several, or None for all of them.
        mutations: the faults.
        on_part: called as each begins, with (done, in all, name).

    Raises:
        ValueError: see `faulty`.
    """
    names = faulty(tasks)
    results = []
    for index, mutation in enumerate(mutations):
        on_part(index, len(mutations), mutation.name)
        affected = [name for name in names if name in mutation.tasks]
        if not affected:
            continue
        with mutation.apply(), _quiet():
            certificate = validate(affected, quick=True, groups=mutation.groups)
        for task in ([""] if set(WITHOUT_TASK) & set(mutation.groups) else []) + affected:
            made = [check for check in certificate.checks if check.task == task]
            failed = tuple(check for check in made if not check.passed)
            results.append(Caught(mutation.name, task, failed, len(made)))
    on_part(len(mutations), len(mutations), "done")
    return results


def as_mapping(certificate: Certificate, caught: Sequence[Caught]) -> dict[str, Any]:
    """What faults did, for JSON, beside what the certificate has; nothing where none was made."""
    rows: list[dict[str, Any]] = []
    for one in caught:
        row: dict[str, Any] = {"mutation": one.mutation, "task": one.task, "made": one.made}
        row["failed"] = [f"{check.group}: {check.name}" for check in one.failed]
        if (clearest := one.clearest) is not None:
            worst = clearest.worst if math.isfinite(clearest.worst) else str(clearest.worst)
            row |= {
                "clearest": f"{clearest.group}: {clearest.name}",
                "worst": worst,
                "allowed": clearest.tolerance,
            }
        rows.append(row)
    blind = [
        f"{check.group}: {check.task}: {check.name}"
        for check in unfailed(certificate.checks, caught)
    ]
    return {"mutations": rows, "failed by no mutation": blind} if rows else {}


def unfailed(checks: Sequence[Check], caught: Sequence[Caught]) -> list[Check]:
    """The checks that no mutation fails: they show nothing, and should go."""
    seen = {(check.group, check.task, check.name) for outcome in caught for check in outcome.failed}
    return [check for check in checks if (check.group, check.task, check.name) not in seen]
