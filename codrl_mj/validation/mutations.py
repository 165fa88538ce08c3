"""Mutation tests of the certificate: deliberate faults, each of which must fail a check.

A fault is made in a model, in the package's source text (an edit that is compiled), or in the
stepping of a simulation, and is undone at the end of a `with` block.
"""

import contextlib
import dataclasses
import inspect
import math
import sys
import types
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache, partial
from unittest import mock

import mujoco
import numpy as np

from codrl_mj import engine
from codrl_mj.actuators import ActuatorModel, current_loop, drive
from codrl_mj.engine import control
from codrl_mj.engine.families import SLOT_HEADER_SIZE, family_replaced
from codrl_mj.engine.hill import GRAVITY
from codrl_mj.physics import MujocoPhysics, SimulationConfig, compiled_task, mjcf
from codrl_mj.physics.variation import bare_model
from codrl_mj.tasks import PAPER_TASKS, find_task
from codrl_mj.validation.certificate import (
    TASK_INDEPENDENT,
    Certificate,
    Progress,
    ignore_progress,
    validate,
)
from codrl_mj.validation.table import Check

Fault = contextlib.AbstractContextManager[object]


@contextlib.contextmanager
def _everywhere(name: str, original: object, wrong: object) -> Iterator[None]:
    """Replace `original` by `wrong` in every module of the package that has it as `name`."""
    # Modules that ran `from … import …` hold their own references.
    modules = [module for key, module in sys.modules.items() if key.startswith("codrl_mj")]
    with contextlib.ExitStack() as stack:
        for module in modules:
            if getattr(module, name, None) is original:
                stack.enter_context(mock.patch.object(module, name, wrong))
        yield


# -- in a model ------------------------------------------------------------------------------------


Part = tuple[str, int | tuple[int, int] | None, float]
"""(array of a model or its options, index in it, factor); the index of a plain number is None."""


@contextlib.contextmanager
def wrong_model(*parts: Part) -> Iterator[None]:
    """Scale parts of every task's model; parts that a model does not have are skipped."""
    build = mjcf.task_model

    def build_wrong(simulation: SimulationConfig) -> mujoco.MjModel:
        model = build(simulation)
        for field, index, factor in parts:
            owner = model.opt if hasattr(model.opt, field) else model
            if index is None:
                setattr(owner, field, getattr(owner, field) * factor)
            elif getattr(owner, field).size:
                getattr(owner, field)[index] *= factor
        return model

    # Models are cached: correct ones from before, and wrong ones from within the block.
    bare_model.cache_clear()
    try:
        with _everywhere("task_model", build, build_wrong):
            yield
    finally:
        bare_model.cache_clear()


# -- in the source text ----------------------------------------------------------------------------

Edit = tuple[str, str]
"""(text that occurs once, its replacement)."""


def compile_edited(module: types.ModuleType, edits: Sequence[Edit]) -> types.ModuleType:
    """Return a second copy of a module, compiled from its edited source text.

    Raises:
        ValueError: the text of an edit does not occur exactly once. The source has changed, and the
            mutation must follow it.
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
"""Memory that a fault shares between all simulations, a number for each actuator of a model."""


@cache
def _wrong_callbacks(edits: tuple[Edit, ...]) -> Callable[[], Mapping[str, object]]:
    """Return the function that compiles the callbacks of the edited source."""
    wrong = compile_edited(control, edits)
    vars(wrong)["HIDDEN"] = _HIDDEN.ctypes.data
    callbacks: Callable[[], Mapping[str, object]] = wrong.motor_callbacks
    return callbacks


@contextlib.contextmanager
def wrong_callback(*edits: Edit) -> Iterator[None]:
    """Let MuJoCo run a callback that is compiled from edited source."""
    names, _, remedy = control._GROUPS["motor"]
    # An installed callback stays until it is uninstalled; the next simulation installs the wrong
    # one.
    engine.uninstall()
    with mock.patch.dict(control._GROUPS, motor=(names, _wrong_callbacks(edits), remedy)):
        try:
            yield
        finally:
            engine.uninstall()


@cache
def _wrong_families(
    module: types.ModuleType, edits: tuple[Edit, ...]
) -> tuple[type[ActuatorModel], ...]:
    """Return the actuator families of a module, compiled from its edited source."""
    wrong = vars(compile_edited(module, edits)).values()
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
    """Let the callback run a loop that is compiled from edited source; plain Python stays correct.

    With `everywhere` the plain-Python loop has the same fault, so that a comparison of the two
    cannot show it.
    """
    with contextlib.ExitStack() as stack:
        for family in _wrong_families(module, edits):
            right = getattr(module, family.__name__)
            stack.enter_context(family_replaced(right, family))
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
_COMMIT = "                commit_slot(family_number, slot, time)\n"
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
_ADVANCED = "                else math.inf,\n            )\n"
_CANDIDATE = SLOT_HEADER_SIZE + len(current_loop.State._fields)
_SHARED_CURRENT: tuple[Edit, ...] = (
    (_COMMIT, f"{_COMMIT}                f64(slot)[{SLOT_HEADER_SIZE}] = f64(HIDDEN)[0]\n"),
    (_ADVANCED, f"{_ADVANCED}            f64(HIDDEN)[0] = f64(slot)[{_CANDIDATE}]\n"),
)


# -- in the stepping of a simulation ---------------------------------------------------------------


_STEP, _MAKE, _RESET = MujocoPhysics.step, MujocoPhysics.__init__, MujocoPhysics.reset


def _late(self: MujocoPhysics, desired_force: float) -> None:
    """Take a step with the command of the step before."""
    force = vars(self).get("waiting", 0.0)
    vars(self)["waiting"] = desired_force
    _STEP(self, force)


def _explicit(self: MujocoPhysics, simulation: SimulationConfig) -> None:
    """Create the physics with the other Euler integrator."""
    wrong_integrator = "semi-implicit" if simulation.integrator == "euler" else "euler"
    _MAKE(self, dataclasses.replace(simulation, integrator=wrong_integrator))


def _warm(self: MujocoPhysics, state: np.ndarray, key: float = 0.0) -> None:
    """Reset the mechanics but not the motor."""
    motor = self.data.act.copy()
    _RESET(self, state, key)
    self.data.act[:] = motor


# -- the list --------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Mutation:
    """A deliberate fault."""

    name: str
    """Short description of the fault."""
    apply: Callable[[], Fault]
    """Function that makes the fault for the duration of a `with` block."""
    groups: tuple[str, ...]
    """Groups of checks that run with the fault."""
    tasks: tuple[str, ...] = tuple(task.name for task in PAPER_TASKS)
    """Tasks in which the fault has an effect."""


_PHYSICS = ("dynamics", "trajectories")
_MECHANICS = (*_PHYSICS, "convergence", "energy")
_LOOP = ("trajectories", "motor")
_UNEQUAL_GAINS = tuple(
    task.name for task in PAPER_TASKS if task.paper[0].controller.kp != task.paper[0].controller.ki
)
_BOUNDED = tuple(task.name for task in PAPER_TASKS if task.constrain is not None)
_RUNGE_KUTTA = tuple(task.name for task in PAPER_TASKS if "rk4" in task.integrators)
_TURNING = ("pendulum", "cartpole", "acrobot")
"""Tasks whose runs show the back-EMF.

Gains that follow the winding hide a wrong resistance from everything but the back-EMF, and the
motors of the mountain cars hardly turn (a difference of 3e-10, where 1e-9 is allowed).
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
"""All faults, with the groups of checks that run with them."""


@dataclasses.dataclass(frozen=True)
class MutationResult:
    """Result of the certificate under a mutation."""

    mutation: str
    """Name of the mutation."""
    task: str
    """Task with the fault; empty for checks that need no task."""
    failed: tuple[Check, ...]
    """Checks that failed."""
    num_checks: int
    """Number of checks that were run."""

    @property
    def clearest_failure(self) -> Check | None:
        """Failed check that exceeds its tolerance by the largest ratio; None if none failed."""
        return max(self.failed, key=lambda check: check.tolerance_ratio, default=None)


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Suppress warnings of overflows, which a fault may cause; the checks report them."""
    handler = mujoco.get_mju_user_warning()
    # MuJoCo's default handler prints each warning and writes a log file.
    mujoco.set_mju_user_warning(lambda _: None)
    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore", RuntimeWarning)
            yield
    finally:
        mujoco.set_mju_user_warning(handler)


def mutation_tasks(tasks: str | Sequence[str] | None = None) -> list[str]:
    """Return the names of the tasks in which faults are made; None selects all built-in tasks.

    Raises:
        ValueError: a task is not built in.
    """
    names = [tasks] if isinstance(tasks, str) else list(tasks or Mutation.tasks)
    for name in names:
        if find_task(name) not in PAPER_TASKS:
            raise ValueError(f"task {name!r}: faults are made only in {', '.join(Mutation.tasks)}")
    return names


def try_mutations(
    tasks: str | Sequence[str] | None = None,
    mutations: Sequence[Mutation] = MUTATIONS,
    on_part: Progress = ignore_progress,
) -> list[MutationResult]:
    """Make each fault in turn and return the checks of the quick certificate that fail.

    Args:
        tasks: name of a built-in task, several names, or None for all.
        mutations: faults to make.
        on_part: progress callback, called before each fault with (finished, total, name).

    Raises:
        ValueError: see `mutation_tasks`.
    """
    names = mutation_tasks(tasks)
    results = []
    for index, mutation in enumerate(mutations):
        on_part(index, len(mutations), mutation.name)
        affected = [name for name in names if name in mutation.tasks]
        if not affected:
            continue
        with mutation.apply(), _quiet():
            certificate = validate(affected, quick=True, groups=mutation.groups)
        for task in ([""] if set(TASK_INDEPENDENT) & set(mutation.groups) else []) + affected:
            checks = [check for check in certificate.checks if check.task == task]
            failed = tuple(check for check in checks if not check.passed)
            results.append(MutationResult(mutation.name, task, failed, len(checks)))
    on_part(len(mutations), len(mutations), "done")
    return results


def as_mapping(certificate: Certificate, results: Sequence[MutationResult]) -> dict[str, object]:
    """Return the results of the faults as JSON-serializable values; empty without faults."""
    rows: list[dict[str, object]] = []
    for result in results:
        row: dict[str, object] = {
            "mutation": result.mutation,
            "task": result.task,
            "made": result.num_checks,
        }
        row["failed"] = [f"{check.group}: {check.name}" for check in result.failed]
        if (clearest := result.clearest_failure) is not None:
            worst = clearest.worst if math.isfinite(clearest.worst) else str(clearest.worst)
            row |= {
                "clearest": f"{clearest.group}: {clearest.name}",
                "worst": worst,
                "allowed": clearest.tolerance,
            }
        rows.append(row)
    undetected = [
        f"{check.group}: {check.task}: {check.name}"
        for check in undetected_checks(certificate.checks, results)
    ]
    return {"mutations": rows, "failed by no mutation": undetected} if rows else {}


def undetected_checks(checks: Sequence[Check], results: Sequence[MutationResult]) -> list[Check]:
    """Return the checks that no mutation fails: they show nothing and should be removed."""
    failed = {
        (check.group, check.task, check.name) for outcome in results for check in outcome.failed
    }
    return [check for check in checks if (check.group, check.task, check.name) not in failed]
