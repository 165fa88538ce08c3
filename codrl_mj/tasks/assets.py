"""Finds the MJCF files and the motors: in a checkout they lie in `assets/`, in a wheel inside the package."""

from pathlib import Path

_PACKAGE = Path(__file__).parents[1]


def asset_folder() -> Path:
    """The folder of the MJCF files and of `motors/`."""
    for folder in (_PACKAGE / "_assets", _PACKAGE.parent / "assets"):
        if folder.is_dir():
            return folder
    raise FileNotFoundError(f"no models beside codrl_mj in {_PACKAGE}: the installation is incomplete")


def asset_path(name: str) -> Path:
    """Path of the MJCF file `name`."""
    if Path(name).is_file():
        return Path(name)
    for folder in (_PACKAGE / "_assets", _PACKAGE.parent / "assets"):
        if (folder / name).is_file():
            return folder / name
    if Path(name).parent == Path():
        raise FileNotFoundError(f"no model {name!r} in {Path.cwd()}, nor among codrl_mj's: give the whole path")
    raise FileNotFoundError(f"no model file {name}")
