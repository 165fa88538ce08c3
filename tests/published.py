"""Published measurements, which are not in the repository: read from the folder CODRL_MJ_DATA."""

import os
from pathlib import Path

import pytest


def published_folder(name):
    """Return the folder of a published set; skip the test with a message if there is none."""
    data = os.environ.get("CODRL_MJ_DATA")
    if not data or not Path(data, "bench_logs", name).is_dir():
        pytest.skip(
            f"NOT RUN: no bench_logs/{name} in CODRL_MJ_DATA = {data!r}: codrl-mj data {name},"
            " CODRL_MJ_DATA=data"
        )
    return Path(data, "bench_logs", name)
