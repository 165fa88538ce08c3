"""Download of published measurements of real motors, verified by digests."""

import tomllib
from pathlib import Path
from typing import TypedDict

from codrl_mj.fields import did_you_mean
from codrl_mj.user_code import asset_path

DATA_SUBFOLDER = "bench_logs"  # subfolder that holds the downloaded data sets


class PublishedFile(TypedDict):
    """A file of a data set."""

    path: str
    """Path in the repository."""
    sha256: str
    """Digest of the content."""


class PublishedDataset(TypedDict):
    """A data set in a repository of its authors."""

    title: str
    source: str
    """Address of the repository."""
    commit: str
    licence: str
    columns: str
    """Mapping of the files' columns, for `read_log`."""
    files: dict[str, PublishedFile]
    """Name of a downloaded file -> its origin."""


def published_datasets() -> dict[str, PublishedDataset]:
    """Return the data sets by name."""
    return tomllib.loads(asset_path("published.toml").read_text(encoding="utf-8"))


def fetch(name: str, folder: Path = Path("data")) -> list[Path]:
    """Download a data set from its authors' repository; files that exist already are not changed.

    Args:
        name: one of `published_datasets`.
        folder: the files are saved in its subfolder `bench_logs/NAME`.

    Returns:
        The paths of the files, the license first.

    Raises:
        ValueError: there is no such data set; the error suggests the nearest name.
        RuntimeError: pooch is not installed.
        OSError: a file cannot be downloaded, or differs from the published file.
    """
    sets = published_datasets()
    if name not in sets:
        raise ValueError(
            f"NAME = {name!r}: {did_you_mean(name, sets)}must be one of {', '.join(sets)}"
        )
    try:
        import pooch
    except ModuleNotFoundError:
        raise RuntimeError(
            "downloading measurements needs pooch: pip install 'codrl-mj[data]'"
        ) from None
    dataset, target = sets[name], folder / DATA_SUBFOLDER / name
    base = dataset["source"].replace("https://github.com/", "https://raw.githubusercontent.com/")
    paths = []
    pooch.get_logger().setLevel("WARNING")
    for file, entry in dataset["files"].items():
        url = f"{base}/{dataset['commit']}/{entry['path']}"
        try:
            paths.append(
                Path(pooch.retrieve(url, f"sha256:{entry['sha256']}", fname=file, path=target))
            )
        # pooch raises a ValueError if the digest differs.
        except ValueError as error:
            raise OSError(
                f"{url}: differs from the published file: {' '.join(str(error).split())}"
            ) from error
        except OSError as error:
            raise OSError(f"{url}: cannot be downloaded: {' '.join(str(error).split())}") from error
    return paths
