"""Metadata of the two wheels, from the project's pyproject.toml: hatchling runs this module."""

import tomllib
from pathlib import Path

from hatchling.metadata.plugin.interface import MetadataHookInterface
from packaging.requirements import Requirement

SHARED_FIELDS = ("license", "requires-python", "keywords", "classifiers")
CORE = "codrl-mj-core"
CORE_PACKAGES = ("numpy", "pint", "pyyaml")
"""Packages that the core requires: arithmetic, the units of datasheets, and actuators' files."""
COMMAND_LINE_PACKAGES = ("rich", "tyro")
"""Packages of the core's extra `cli`."""


class WheelMetadata(MetadataHookInterface):
    """Fields of a wheel that the project's pyproject.toml has already."""

    def update(self, metadata: dict[str, object]) -> None:
        """Fill the dynamic fields of the wheel's metadata in place."""
        root = Path(self.root).parents[1]
        project = tomllib.loads((root / "pyproject.toml").read_text())["project"]
        metadata.update({field: project[field] for field in SHARED_FIELDS})
        required = {Requirement(text).name: text for text in project["dependencies"]}
        if metadata["name"] == CORE:
            metadata["scripts"] = project["scripts"]
            metadata["dependencies"] = [required[name] for name in CORE_PACKAGES]
            metadata["optional-dependencies"] = {
                "cli": [required[name] for name in COMMAND_LINE_PACKAGES]
            }
        else:
            core = f"{CORE}=={metadata['version']}"
            metadata["description"] = project["description"]
            metadata["dependencies"] = [core, *project["dependencies"]]
            metadata["optional-dependencies"] = project["optional-dependencies"]
