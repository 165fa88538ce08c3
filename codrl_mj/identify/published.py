"""Measurements of real motors that others have published, fetched as they are published, each file by its digest."""

import tomllib
from pathlib import Path
from typing import Any

from codrl_mj.fields import did_you_mean
from codrl_mj.user_code import asset_path

LAYOUT = "bench_logs"  # where in a folder of data the sets are


def published_datasets() -> dict[str, dict[str, Any]]:
    """What is published, by name: `title`, `source`, `commit`, `licence`, `columns` for `read_log`, and `files`."""
    return tomllib.loads(asset_path("published.toml").read_text(encoding="utf-8"))


def fetch(name: str, folder: Path = Path("data")) -> list[Path]:
    """Fetch a set of measurements from where its authors have it; files that are there already are left alone.

    Args:
        name: one of `published`.
        folder: the files come into `bench_logs/NAME` in it.

    Returns:
        The files, their licence first.

    Raises:
        ValueError: there is no such set; the nearest is suggested.
        RuntimeError: pooch is not installed.
        OSError: a file cannot be had, or is not the one that was published.
    """
    sets = published_datasets()
    if name not in sets:
        raise ValueError(
            f"NAME = {name!r}: {did_you_mean(name, sets)}published are {', '.join(sets)}"
        )
    try:
        import pooch
    except ModuleNotFoundError:
        raise RuntimeError(
            "measurements are fetched by pooch: pip install 'codrl-mj[data]'"
        ) from None
    known, place = sets[name], folder / LAYOUT / name
    base = known["source"].replace("https://github.com/", "https://raw.githubusercontent.com/")
    found = []
    pooch.get_logger().setLevel("WARNING")
    for file, about in known["files"].items():
        url = f"{base}/{known['commit']}/{about['path']}"
        try:
            found.append(
                Path(pooch.retrieve(url, f"sha256:{about['sha256']}", fname=file, path=place))
            )
        except ValueError as error:  # of another digest
            raise OSError(
                f"{url}: is not the file that was published: {' '.join(str(error).split())}"
            ) from error
        except OSError as error:
            raise OSError(f"{url}: cannot be had: {' '.join(str(error).split())}") from error
    return found
