"""Tests of `codrl_mj.actuators`."""
