"""Tests of `codrl_mj.physics`."""
