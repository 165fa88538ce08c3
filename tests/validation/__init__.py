"""Tests of `codrl_mj.validation`."""
