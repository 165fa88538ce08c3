"""Tests of `codrl_mj.callbacks`."""
