"""Tests of the names of published runs, which end with a hash of the run's configuration."""

import csv
from pathlib import Path

import pytest

from actuator_study.study import ActuatorStudy
from insurance_study.study import InsuranceStudy
from reproduction.study import Reproduction

RESULTS = Path(__file__).parents[2] / "docs/results"


def published_names(folder):
    with (RESULTS / folder / "runs.csv").open() as file:
        return {row["run"] for row in csv.DictReader(file)}


def computed_names(grid):
    return {path.name for path in grid.folders.values()}


@pytest.mark.parametrize(
    ("study", "folder"), [(ActuatorStudy, "actuators"), (InsuranceStudy, "insurance")]
)
def test_configurations_give_the_published_names(study, folder):
    published = published_names(folder)
    assert len(published) > 700
    assert published <= computed_names(study().grid)


def test_configurations_of_the_reproduction_give_the_names_since_their_last_change():
    """Arms that were trained before configurations had their present fields keep other names."""
    names = published_names("reproduction") & computed_names(Reproduction().every)
    assert len(names) == 115
    assert {name.split("-")[0] for name in names} == {
        *("pendulum", "cartpole", "acrobot", "mountain_car", "mountain_car_continuous")
    }
