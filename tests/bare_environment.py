"""Virtual environments with few of the packages that are installed here."""

import importlib.metadata
import os
import re
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

from packaging.requirements import Requirement


class BareEnvironment:
    """A virtual environment without packages at first; packages of this environment are linked."""

    def __init__(self, folder):
        """Create the environment in an empty folder."""
        venv.create(folder, symlinks=True)
        self.folder = folder
        paths = {"base": str(folder), "platbase": str(folder)}
        self.library = Path(sysconfig.get_path("purelib", "venv", paths))

    def link(self, requirements):
        """Link the distributions that requirements need, as they are installed here.

        Returns:
            Name -> version of these distributions.
        """
        # The setuptools of an environment may be older than a package requires.
        names = needed_distributions(requirements) - {"setuptools"}
        for name in names:
            distribution = importlib.metadata.distribution(name)
            for entry in {file.parts[0] for file in distribution.files} - {"..", "__pycache__"}:
                source = Path(distribution.locate_file(entry)).resolve()
                if not (self.library / entry).exists() and not entry.endswith(".pth"):
                    (self.library / entry).symlink_to(source)
        return {name: importlib.metadata.version(name) for name in names}

    def add_path(self, folder):
        """Let the environment import from a folder."""
        (self.library / "more.pth").write_text(str(folder))

    def pip(self, *arguments):
        """Run pip for the environment, and return the finished process."""
        pip = [sys.executable, "-m", "pip", "--python", self.folder / "bin" / "python"]
        return subprocess.run(
            [*pip, *arguments], capture_output=True, text=True, timeout=1200, check=False
        )

    def run(self, *arguments, program="python"):
        """Run a program of the environment in its folder, and return the finished process."""
        clean = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
        command = [self.folder / "bin" / program, *arguments]
        return subprocess.run(
            command,
            cwd=self.folder,
            env=clean,
            capture_output=True,
            text=True,
            timeout=300,
            check=False,
        )


def needed_distributions(requirements):
    """Return the names of all distributions that requirements need, directly or indirectly."""
    waiting, names = [Requirement(text) for text in requirements], set()
    while waiting:
        requirement = waiting.pop()
        name = re.sub(r"[-_.]+", "-", requirement.name).lower()
        environments = [{"extra": extra} for extra in ("", *requirement.extras)]
        if name in names or (requirement.marker and not requirement.marker.evaluate({"extra": ""})):
            continue
        names.add(name)
        # The project itself requires what the caller names, and is not searched.
        for text in importlib.metadata.requires(name) or [] if name != "codrl-mj" else []:
            needed = Requirement(text)
            if needed.marker is None or any(map(needed.marker.evaluate, environments)):
                needed.marker = None
                waiting.append(needed)
    return names
