"""Tests of `codrl_mj.engine`."""
