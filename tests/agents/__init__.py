"""Tests of `codrl_mj.agents`."""
