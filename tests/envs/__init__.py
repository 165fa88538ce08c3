"""Tests of `codrl_mj.envs`."""
