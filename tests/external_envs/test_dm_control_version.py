"""Errors for a dm_control that cannot load models of the installed MuJoCo."""

import importlib.metadata

import mujoco
import pytest

from codrl_mj.external_envs import check_dm_control


def fake_versions(monkeypatch, mujoco_version, dm_control_version):
    monkeypatch.setattr(mujoco, "__version__", mujoco_version)
    monkeypatch.setattr(
        importlib.metadata, "version", lambda name: {"dm-control": dm_control_version}[name]
    )


@pytest.mark.parametrize(
    ("engine", "version"), [("4.0.0", "1.0.50"), ("4.1.0", "1.0.41"), ("5.0.0", "1.0.50")]
)
def test_raises_and_names_both_versions_if_mujoco_is_too_new(monkeypatch, engine, version):
    fake_versions(monkeypatch, engine, version)
    with pytest.raises(
        RuntimeError,
        match=rf"dm_control {version} does not work with MuJoCo {engine}.*\[dm-control\]",
    ):
        check_dm_control()


@pytest.mark.parametrize(
    ("engine", "version"), [("3.17.0", "1.0.50"), ("3.99.1", "1.0.41"), ("4.0.0", "1.0.51")]
)
def test_accepts_versions_that_fit(monkeypatch, engine, version):
    fake_versions(monkeypatch, engine, version)
    check_dm_control()


def test_raises_package_not_found_if_dm_control_is_missing(monkeypatch):
    def missing(name):
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(importlib.metadata, "version", missing)
    with pytest.raises(importlib.metadata.PackageNotFoundError):
        check_dm_control()
