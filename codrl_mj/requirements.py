"""Checks of the packages that simulation needs, and messages on packages that are missing.

Two wheels have this package: `codrl-mj-core` has the code and requires few packages, so that pip
can install it beside a simulator that pins an older MuJoCo. `codrl-mj` has no code; it requires the
core and all that simulation needs.
"""

import functools
import importlib.abc
import importlib.metadata
import importlib.util
import re
import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec
from types import ModuleType

MIN_MUJOCO = (3, 17)
"""Oldest MuJoCo that the engine supports; the same as in pyproject.toml."""
SIMULATION_PACKAGES = ("numba", "gymnasium", "mujoco")
"""Packages without which the engine and the environments cannot be imported."""
CORE_PACKAGES = {
    *("__main__", "actuators", "arrays", "boundary", "catalogue", "cli", "disturbances", "fields"),
    *("plots", "requirements", "user_code"),
}
"""Packages and modules that need only what codrl-mj-core requires, or their simulator."""
CORE_MODULES = {
    *("engine", "engine.joint_dynamics", "engine.matching", "engine.shafts"),
    *("envs", "envs.distributions", "envs.motor_fields", "envs.patterns", "runs", "runs.files"),
    *("sizing", "sizing.choice", "sizing.feasibility", "sizing.joint_demand", "sizing.limits"),
    *("sizing.loop", "sizing.servo_response", "sizing.swing"),
}
"""Further modules of this kind, in packages that have others too."""
DISTRIBUTIONS = {"PIL": "pillow", "serial": "pyserial"}
"""Module -> its distribution, if the two have different names."""
_NOT_FOR_USERS = {"bench", "dev", "docs"}
_REMEDY = (
    "The package codrl-mj-core offers actuators, datasheets and codrl_mj.arrays. For the rest: pip"
    " install codrl-mj"
)


class MissingPackageError(ImportError):
    """A package that this part of codrl_mj needs is missing or too old."""


@functools.cache
def simulation_problem() -> str:
    """Return why engine and environments cannot be used here, and the remedy; empty if they can."""
    for package in SIMULATION_PACKAGES:
        if importlib.util.find_spec(package) is None:
            return f"{package} is not installed. {_REMEDY}"
    # Importing mujoco would be too early: it reads MUJOCO_GL once, at its import.
    version = importlib.metadata.version("mujoco")
    if tuple(int(number) for number in version.split(".")[:2]) < MIN_MUJOCO:
        oldest = ".".join(map(str, MIN_MUJOCO))
        return (
            f"it needs MuJoCo {oldest} or newer, and {version} is installed. {_REMEDY}, in an"
            " environment whose other packages do not need the older MuJoCo"
        )
    return ""


class _SimulationRefuser(importlib.abc.MetaPathFinder):
    """Import hook that refuses the modules of this package outside the core, with the remedy."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        del path, target
        package, _, module = fullname.partition(".")
        is_core = module.partition(".")[0] in CORE_PACKAGES or module in CORE_MODULES
        if package == __package__ and module and not is_core:
            raise MissingPackageError(f"{fullname} cannot be imported: {simulation_problem()}")
        return None


def refuse_simulation() -> None:
    """Let each import of a module outside the core raise a `MissingPackageError` from now on."""
    sys.meta_path.insert(0, _SimulationRefuser())


def missing_module_message(error: ModuleNotFoundError) -> str:
    """Return a sentence that names a missing module and the packages or extras that install it.

    The extras are read from the metadata of the installed package, so that there is no second list
    of them.

    Args:
        error: the error of an import, or of `importlib.metadata`.
    """
    module = (error.name or "").partition(".")[0]
    distribution = DISTRIBUTIONS.get(module, module).replace("_", "-").lower()
    project, requirements = "codrl-mj", _requirements("codrl-mj")
    if not requirements:
        project, requirements = "codrl-mj-core", _requirements("codrl-mj-core")
    extras = _extras_with(distribution, requirements)
    if not extras:
        return f"{' '.join(str(error).split())}: install the package that provides it"
    if len(extras) == 1:
        return (
            f"{module} is not installed. The extra '{extras[0]}' installs it: pip install"
            f" '{project}[{extras[0]}]'"
        )
    names = ", ".join(f"'{extra}'" for extra in extras)
    return (
        f"{module} is not installed. Each of the extras {names} installs it: pip install one of"
        f" them, or '{project}[all]'"
    )


def _requirements(distribution: str) -> list[str]:
    """Return the requirements in a distribution's metadata; empty if it is not installed."""
    try:
        return importlib.metadata.requires(distribution) or []
    # A checkout that was not installed has no metadata.
    except importlib.metadata.PackageNotFoundError:
        return []


def _extras_with(distribution: str, requirements: list[str]) -> list[str]:
    """Return the extras that require a distribution; skip those that include another of them."""
    extras: dict[str, set[str]] = {}
    for requirement in requirements:
        name = re.match(r"[\w-]+", requirement)
        extra = re.search(r"extra == ['\"](?P<name>[\w-]+)['\"]", requirement)
        if name and extra and extra["name"] not in _NOT_FOR_USERS:
            extras.setdefault(extra["name"], set()).add(name[0].lower())
    matching = {extra: names for extra, names in extras.items() if distribution in names}
    return [
        extra
        for extra, names in matching.items()
        if not any(subset < names for subset in matching.values())
    ]
