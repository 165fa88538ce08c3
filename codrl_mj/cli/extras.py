"""Error message for a missing module, with the extras of this package that install it."""

import importlib.metadata
import re

DISTRIBUTIONS = {"PIL": "pillow", "serial": "pyserial"}
"""Module -> its distribution, if the two have different names."""
_NOT_FOR_USERS = {"bench", "dev", "docs"}


def missing_module_message(error: ModuleNotFoundError) -> str:
    """Return a sentence that names a missing module and the extras of this package that install it.

    The extras are read from the metadata of the installed package, so that there is no second list
    of them.

    Args:
        error: the error of an import, or of `importlib.metadata`.
    """
    module = (error.name or "").partition(".")[0]
    distribution = DISTRIBUTIONS.get(module, module).replace("_", "-").lower()
    extras = _extras_with(distribution)
    if not extras:
        return f"{' '.join(str(error).split())}: install the package that provides it"
    if len(extras) == 1:
        return (
            f"{module} is not installed. The extra '{extras[0]}' installs it: pip install"
            f" 'codrl-mj[{extras[0]}]'"
        )
    names = ", ".join(f"'{extra}'" for extra in extras)
    return (
        f"{module} is not installed. Each of the extras {names} installs it: pip install one of"
        " them, or 'codrl-mj[all]'"
    )


def _extras_with(distribution: str) -> list[str]:
    """Return the extras that require a distribution; skip those that include another of them."""
    try:
        requirements = importlib.metadata.requires("codrl-mj") or []
    # A checkout that was not installed has no metadata.
    except importlib.metadata.PackageNotFoundError:
        return []
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
