"""The certificate: all groups of checks over all tasks, or over a user's own model, and what they found."""

import copy
import dataclasses
import importlib
import importlib.metadata
import math
import platform
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import mujoco

from codrl_mj.engine.specs import NO_ACTUATORS_READ
from codrl_mj.physics import install_callbacks, motors
from codrl_mj.tasks import PAPER_TASKS, TASKS, find_task
from codrl_mj.validation import execution, own_model
from codrl_mj.validation.compare import is_ours
from codrl_mj.validation.table import REPORT, Check, Skipped

GROUPS: dict[str, str] = {
    "dynamics": "Accelerations and single steps against the installed Gymnasium",
    "trajectories": "Whole runs against the installed Gymnasium, and what chaos makes of rounding",
    "convergence": (
        "Ever smaller steps, ever faster loops: the order at which the solutions converge"
    ),
    "motor": "The motor and its current loop against closed forms and other people's motors",
    "energy": "Every joule that goes in comes out",
    "execution": "Batched, copied, restored, looked at: the same bits",
}
"""The parts of the certificate, in order, with what they are."""

WITHOUT_TASK = ("motor",)
"""Groups that are run once, whatever the tasks; and once more for every task that is not ours."""

DIVERGED = "runs to its end"
"""Name of the check that fails where a simulation breaks down."""
PACKAGES = (
    "codrl-mj",
    "mujoco",
    "gymnasium",
    "numpy",
    "scipy",
    "numba",
    "control",
    "gym-electric-motor",
)


@dataclasses.dataclass(frozen=True)
class Certificate:
    """What was checked, what was found, and with which software."""

    subject: str
    """What was checked: tasks, or a model."""
    checks: tuple[Check, ...]
    """In the order of `GROUPS`."""
    skipped: tuple[Skipped, ...]
    """What was not checked, and why."""
    quick: bool
    """Whether it is the quick form: fewer states, runs and step sizes."""
    seconds: float
    """How long it took [s]."""

    @property
    def passed(self) -> bool:
        """Whether every check passed, and there was one."""
        return bool(self.checks) and all(check.passed for check in self.checks)

    @property
    def verdict(self) -> str:
        """In a few words how many checks failed, or passed."""
        return verdict([check.passed for check in self.checks])

    def as_mapping(self) -> dict[str, Any]:
        """Everything but the plots, for JSON; infinities and NaN as text."""
        checks: list[dict[str, Any]] = []
        for check in self.checks:
            row = {
                one.name: getattr(check, one.name)
                for one in dataclasses.fields(check)
                if one.name != "plots"
            }
            text = {
                name: str(one)
                for name, one in row.items()
                if isinstance(one, float) and not math.isfinite(one)
            }
            checks.append(row | text | {"samples": int(check.samples), "passed": check.passed})
        return {
            "format": "codrl_mj certificate 1",
            "subject": self.subject,
            "verdict": "passed" if self.passed else "FAILED",
            "quick": self.quick,
            "seconds": round(self.seconds, 1),
            "made": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
            "versions": versions(),
            "checks": checks,
            "skipped": [dataclasses.asdict(skip) for skip in self.skipped],
        }


def verdict(passed: Sequence[bool]) -> str:
    """In a few words how many of some checks failed, or passed."""
    failed = passed.count(False)
    count = f"of {len(passed)} checks"
    return f"{failed} {count} FAILED" if failed or not passed else f"passed: {len(passed)} {count}"


def versions() -> dict[str, str]:
    """The versions of everything that a verdict depends on."""
    found = {"Python": platform.python_version(), "platform": platform.platform(terse=True)}
    for package in PACKAGES:
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            found[package] = "not installed"
    return found


Outcomes = Iterator[Check | Skipped]
Progress = Callable[[int, int, str], object]
"""(parts done, parts in all, the part that begins) -> what nobody looks at."""


def ignore_progress(*_: object) -> None:
    """What is called where nobody listens."""


def _certify(
    subject: str,
    parts: Sequence[tuple[str, str, Outcomes]],
    skipped: Sequence[Skipped],
    quick: bool,
    on_part: Progress,
) -> Certificate:
    """Make the parts: a group, a task or model, and its outcomes as they come, which are then said to be of these.

    A simulation that breaks down is a failed check, a missing library a skipped one.
    """
    started = time.perf_counter()
    found: list[Check] = []
    skips = list(skipped)
    for index, (group, task, outcomes) in enumerate(parts):
        on_part(index, len(parts), f"{group}, {task}" if task else group)
        for outcome in _to_the_end(outcomes):
            if isinstance(outcome, Skipped):
                skips.append(dataclasses.replace(outcome, group=group, task=task))
            else:
                made = dataclasses.replace(outcome, group=group, task=task)
                found.append(
                    made
                    if made.passed
                    else dataclasses.replace(made, fault=made.fault or _fault(made))
                )
    on_part(len(parts), len(parts), "done")
    return Certificate(subject, tuple(found), tuple(skips), quick, time.perf_counter() - started)


_OWN = (
    "an `advance` or a function of your own has to depend on its arguments alone; if it does,"
    f" {REPORT}"
)
_RUN = f"if it passes on a gentler run in Task.reference_states, this one was too violent; if not, {REPORT}"
_TWIN = "your model and your twin differ: compare masses, gravity and the integrator"
_FAULTS = {"dynamics": _TWIN, "trajectories": _TWIN, "convergence": _RUN, "energy": _RUN}
"""Whose fault it is if a check of somebody's own task or model fails, by its group."""


def _fault(check: Check) -> str:
    """Return whose fault a failed check is, as far as its task and group tell."""
    if not check.task or (check.task in TASKS and is_ours(TASKS[check.task])):
        return REPORT
    if check.name == DIVERGED or check.name.startswith("stable: "):
        return (
            "your model or motor is not stable at this step: shorten it, or slow down the motor's"
            " loop"
        )
    return _FAULTS.get(check.group, _OWN)


def _to_the_end(outcomes: Outcomes) -> Outcomes:
    try:
        yield from outcomes
    except ModuleNotFoundError as error:
        yield Skipped("the rest of the group", f"{error}: pip install 'codrl-mj[validate]'")
    except ArithmeticError as error:  # a SimulationDivergedError is one
        reason = f"{type(error).__name__}: {error}"
        yield Check(DIVERGED, "itself", 0.0, "", 1, math.inf, reason)


def validate(
    tasks: str | Sequence[str] | None = None,
    *,
    quick: bool = False,
    groups: Sequence[str] | None = None,
    on_part: Progress = ignore_progress,
) -> Certificate:
    """Check that the port is right.

    A task of one's own is put through all that applies to it: what needs a twin, or states and a
    run of `Task.reference_states`, is skipped without them.

    Args:
        tasks: a task, several, or None for all that are registered.
        quick: fewer states, runs and step sizes: seconds instead of minutes.
        groups: some of `GROUPS`; None for all of them.
        on_part: called as each group and task begins.

    Raises:
        ValueError: an unknown task or group, or none.
    """
    given = list(TASKS) if tasks is None else [tasks] if isinstance(tasks, str) else list(tasks)
    if not given or (groups is not None and not list(groups)):
        raise ValueError(
            f"tasks = {tasks!r}, groups = {groups!r}: must name one at least; None stands for all"
            " of them"
        )
    names = dict.fromkeys(find_task(name).name for name in given)
    others = [name for name in names if TASKS[name] not in PAPER_TASKS]
    chosen = list(GROUPS) if groups is None else list(groups)
    for group in chosen:
        if group not in GROUPS:
            raise ValueError(
                f"unknown group of checks {group!r}: must be one of {', '.join(GROUPS)}"
            )

    def of_task(group: str, task: str | None) -> Outcomes:
        module = "own_model" if group in WITHOUT_TASK and task is not None else group
        # imported here: some need libraries that nothing else does
        yield from importlib.import_module(f"codrl_mj.validation.{module}").checks(task, quick)

    parts = [
        (group, task or "", of_task(group, task))
        for group in GROUPS
        if group in chosen
        for task in ([None, *others] if group in WITHOUT_TASK else names)
    ]
    subject = "all tasks" if len(names) == len(TASKS) else ", ".join(names)
    return _certify(subject, parts, (), quick, on_part)


def validate_model(
    model: mujoco.MjModel,
    name: str = "model",
    *,
    quick: bool = False,
    on_part: Progress = ignore_progress,
) -> Certificate:
    """Put a model of your own, with any number of our motors, through the checks that apply to it.

    Args:
        model: a compiled model; it is not changed.
        name: its name in the certificate.
        quick: fewer simulations and steps.
        on_part: called as each part begins.

    Raises:
        ValueError: the model has no motor of ours, or one that is not as it should be.
        CallbackInUseError: another library's MuJoCo callback is installed where ours has to go.
    """
    if not model.nactuator:
        raise ValueError(
            f"the model has no actuators ({NO_ACTUATORS_READ}): add one per joint, put motors"
            " behind them with codrl_mj.add_motors, and validate what it makes"
        )
    if not motors(model):
        raise ValueError(
            f"the model has no motor of codrl_mj among its {model.nactuator} actuators: put some in"
            " with codrl_mj.add_motors"
        )
    subject = copy.copy(model)
    subject.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET  # it is left to diverge
    install_callbacks(subject)
    parts = [
        ("motor", name, own_model.motor_checks(subject, quick)),
        ("execution", name, execution.model_checks(subject, quick, execution.FULL_STATE)),
    ]
    unknown = [
        Skipped("all checks", reason, group, name) for group, reason in own_model.UNKNOWN.items()
    ]
    return _certify(name, parts, unknown, quick, on_part)
