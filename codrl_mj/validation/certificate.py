"""The certificate: the results of all groups of checks on tasks or on a user's model."""

import copy
import dataclasses
import importlib.metadata
import math
import platform
import time
from collections.abc import Callable, Iterator, Sequence

import mujoco

from codrl_mj.engine.matching import NO_ACTUATORS_READ
from codrl_mj.physics import install_callbacks, motors
from codrl_mj.tasks import PAPER_TASKS, TASKS, find_task
from codrl_mj.validation import execution, own_model
from codrl_mj.validation.compare import is_built_in
from codrl_mj.validation.table import REPORT, Check, Skipped

GROUPS: dict[str, str] = {
    "dynamics": "Accelerations and single steps against the installed Gymnasium",
    "trajectories": "Whole runs against the installed Gymnasium, and the growth of rounding errors",
    "convergence": ("Orders of convergence as steps become smaller and current loops faster"),
    "motor": "The motor and its current loop against closed forms and third-party motors",
    "energy": "Energy balances of supply, motor and mechanics",
    "execution": "Bitwise equality of batched, copied, restored and inspected simulations",
}
"""Title of each group of checks, in the order in which they run."""

TASK_INDEPENDENT = ("motor",)
"""Groups that run once for all built-in tasks together, and once for each custom task."""

DIVERGED = "runs to its end"
"""Name of the check that fails if a simulation diverges."""
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
    """Results of all checks on a subject, with the versions of the software."""

    subject: str
    """Names of the tasks or of the model that were checked."""
    checks: tuple[Check, ...]
    """Completed checks, in the order of `GROUPS`."""
    skipped: tuple[Skipped, ...]
    """Checks that were not run, with the reasons."""
    quick: bool
    """True for the quick form, which has fewer states, runs and step sizes."""
    seconds: float
    """Total duration of the checks [s]."""

    @property
    def passed(self) -> bool:
        """True if at least one check was run and all passed."""
        return bool(self.checks) and all(check.passed for check in self.checks)

    @property
    def verdict(self) -> str:
        """Short text with the number of checks that failed or passed."""
        return verdict([check.passed for check in self.checks])

    def as_mapping(self) -> dict[str, object]:
        """Return all fields except the plots, for JSON; infinities and NaN become text."""
        checks: list[dict[str, object]] = []
        for check in self.checks:
            row = {
                field.name: getattr(check, field.name)
                for field in dataclasses.fields(check)
                if field.name != "plots"
            }
            # JSON has no infinities and no NaN.
            nonfinite = {
                name: str(value)
                for name, value in row.items()
                if isinstance(value, float) and not math.isfinite(value)
            }
            checks.append(row | nonfinite | {"samples": int(check.samples), "passed": check.passed})
        return {
            "format": "codrl_mj certificate 1",
            "subject": self.subject,
            "verdict": "passed" if self.passed else "FAILED",
            "quick": self.quick,
            "seconds": round(self.seconds, 1),
            "made": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
            "versions": versions(),
            "checks": checks,
            "skipped": [dataclasses.asdict(skipped) for skipped in self.skipped],
        }


def verdict(passed: Sequence[bool]) -> str:
    """Return a short text with the number of checks that failed or passed."""
    failed = passed.count(False)
    count = f"of {len(passed)} checks"
    return f"{failed} {count} FAILED" if failed or not passed else f"passed: {len(passed)} {count}"


def versions() -> dict[str, str]:
    """Return the versions of all software that the results depend on."""
    versions_by_name = {
        "Python": platform.python_version(),
        "platform": platform.platform(terse=True),
    }
    for package in PACKAGES:
        try:
            versions_by_name[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            versions_by_name[package] = "not installed"
    return versions_by_name


Outcomes = Iterator[Check | Skipped]
Progress = Callable[[int, int, str], object]
"""Progress callback: (finished parts, total parts, next part) -> ignored."""


def ignore_progress(*_: object) -> None:
    """Do nothing; the default progress callback."""


def _certify(
    subject: str,
    parts: Sequence[tuple[str, str, Outcomes]],
    skipped: Sequence[Skipped],
    quick: bool,
    on_part: Progress,
) -> Certificate:
    """Run all parts and collect their results in a certificate.

    A simulation that diverges becomes a failed check, a missing library a skipped check.

    Args:
        subject: name of the checked tasks or model.
        parts: group, name of the task or model, and iterator of its results. Group and name are
            written into each result.
        skipped: checks that are known not to apply.
        quick: True for the quick form.
        on_part: progress callback.
    """
    started = time.perf_counter()
    completed: list[Check] = []
    all_skipped = list(skipped)
    for index, (group, task, outcomes) in enumerate(parts):
        on_part(index, len(parts), f"{group}, {task}" if task else group)
        for outcome in _convert_errors(outcomes):
            if isinstance(outcome, Skipped):
                all_skipped.append(dataclasses.replace(outcome, group=group, task=task))
            else:
                completed_check = dataclasses.replace(outcome, group=group, task=task)
                completed.append(
                    completed_check
                    if completed_check.passed
                    else dataclasses.replace(
                        completed_check,
                        fault=completed_check.fault or _likely_cause(completed_check),
                    )
                )
    on_part(len(parts), len(parts), "done")
    return Certificate(
        subject, tuple(completed), tuple(all_skipped), quick, time.perf_counter() - started
    )


_IMPURE_FUNCTION = (
    "a custom `advance` or other custom function must depend on its arguments only; if it does,"
    f" {REPORT}"
)
_VIOLENT_RUN = (
    "if the check passes on a gentler run in Task.reference_states, this run was too violent; if"
    f" not, {REPORT}"
)
_DIFFERENT_MODELS = (
    "your model and your reference environment (Task.reference_env) differ: compare masses, gravity"
    " and the integrator"
)
_LIKELY_CAUSES = {
    "dynamics": _DIFFERENT_MODELS,
    "trajectories": _DIFFERENT_MODELS,
    "convergence": _VIOLENT_RUN,
    "energy": _VIOLENT_RUN,
}
"""Group -> likely cause of a failed check on a custom task or model."""


def _likely_cause(check: Check) -> str:
    """Return the likely cause of a failed check, derived from its task, name and group."""
    if not check.task or (check.task in TASKS and is_built_in(TASKS[check.task])):
        return REPORT
    if check.name == DIVERGED or check.name.startswith("stable: "):
        return (
            "your model or motor is not stable at this step: shorten the step, or slow down the"
            " motor's loop"
        )
    return _LIKELY_CAUSES.get(check.group, _IMPURE_FUNCTION)


def _convert_errors(outcomes: Outcomes) -> Outcomes:
    """Yield the results; a missing library skips the rest, a divergence becomes a failed check."""
    try:
        yield from outcomes
    except ModuleNotFoundError as error:
        yield Skipped("the rest of the group", f"{error}: pip install 'codrl-mj[validate]'")
    # SimulationDivergedError is a subclass of ArithmeticError.
    except ArithmeticError as error:
        reason = f"{type(error).__name__}: {error}"
        yield Check(DIVERGED, "itself", 0.0, "", 1, math.inf, reason)


def _checks_of(group: str, has_task: bool) -> Callable[..., Outcomes]:
    """Return the function (task, quick) that runs a group's checks.

    The task is a name; it is None for a group of `TASK_INDEPENDENT` on all built-in tasks.
    """
    # The imports are local because some groups need optional libraries. A missing library then
    # skips its own group only (`_convert_errors`).
    if group == "dynamics":
        from codrl_mj.validation.dynamics import checks
    elif group == "trajectories":
        from codrl_mj.validation.trajectories import checks
    elif group == "convergence":
        from codrl_mj.validation.convergence import checks
    elif group == "energy":
        from codrl_mj.validation.energy import checks
    elif group == "execution":
        return execution.checks
    elif has_task:
        return own_model.checks
    else:
        from codrl_mj.validation.motor import checks
    return checks


def validate(
    tasks: str | Sequence[str] | None = None,
    *,
    quick: bool = False,
    groups: Sequence[str] | None = None,
    on_part: Progress = ignore_progress,
) -> Certificate:
    """Run the checks on tasks and return their certificate.

    A custom task runs through all checks that apply to it. Checks that need a reference environment
    (`Task.reference_env`), or the states and the run of `Task.reference_states`, are skipped if the
    task has none.

    Args:
        tasks: name of a task, several names, or None for all registered tasks.
        quick: True for fewer states, runs and step sizes: seconds instead of minutes.
        groups: names from `GROUPS`; None for all.
        on_part: progress callback, called before each group and task.

    Raises:
        ValueError: a task or group is unknown, or none is named.
    """
    requested = list(TASKS) if tasks is None else [tasks] if isinstance(tasks, str) else list(tasks)
    if not requested or (groups is not None and not list(groups)):
        raise ValueError(
            f"tasks = {tasks!r}, groups = {groups!r}: must name at least one; None selects all"
        )
    names = dict.fromkeys(find_task(name).name for name in requested)
    custom_tasks = [name for name in names if TASKS[name] not in PAPER_TASKS]
    selected_groups = list(GROUPS) if groups is None else list(groups)
    for group in selected_groups:
        if group not in GROUPS:
            raise ValueError(
                f"unknown group of checks {group!r}: must be one of {', '.join(GROUPS)}"
            )

    def run_group(group: str, task: str | None) -> Outcomes:
        yield from _checks_of(group, task is not None)(task, quick)

    parts = [
        (group, task or "", run_group(group, task))
        for group in GROUPS
        if group in selected_groups
        for task in ([None, *custom_tasks] if group in TASK_INDEPENDENT else names)
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
    """Run the checks that apply to a custom model with codrl_mj motors.

    Args:
        model: a compiled model; it is not changed.
        name: name of the model in the certificate.
        quick: True for fewer simulations and steps.
        on_part: progress callback, called before each part.

    Raises:
        ValueError: the model has no codrl_mj motor, or one with invalid data.
        CallbackInUseError: another library has installed the MuJoCo callback that codrl_mj needs.
    """
    if not model.nactuator:
        raise ValueError(
            f"the model has no actuators ({NO_ACTUATORS_READ}): add one per joint, put motors"
            " behind them with codrl_mj.add_motors, and validate the resulting model"
        )
    if not motors(model):
        raise ValueError(
            f"the model has no motor of codrl_mj among its {model.nactuator} actuators: add motors"
            " with codrl_mj.add_motors"
        )
    subject = copy.copy(model)
    # With autoreset the engine would silently restart a diverged simulation, and the divergence
    # would go unnoticed.
    subject.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    install_callbacks(subject)
    parts = [
        ("motor", name, own_model.motor_checks(subject, quick)),
        ("execution", name, execution.model_checks(subject, quick, execution.FULL_STATE)),
    ]
    not_applicable = [
        Skipped("all checks", reason, group, name)
        for group, reason in own_model.NOT_APPLICABLE.items()
    ]
    return _certify(name, parts, not_applicable, quick, on_part)
