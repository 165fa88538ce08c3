"""Tests of `codrl_mj.motor`."""
