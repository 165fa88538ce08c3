"""Measurements of others, which are not part of the repository: read from the folder that CODRL_MJ_DATA names."""

import os
from pathlib import Path

import pytest


def folder_of(name):
    """The folder of a published set; without it the test that asks is not run, and says so."""
    data = os.environ.get("CODRL_MJ_DATA")
    if not data or not Path(data, "bench_logs", name).is_dir():
        pytest.skip(
            f"NOT RUN: no bench_logs/{name} in CODRL_MJ_DATA = {data!r}: codrl-mj data {name},"
            " CODRL_MJ_DATA=data"
        )
    return Path(data, "bench_logs", name)
