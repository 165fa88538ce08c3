"""Tests of motors in third-party models, with MuJoCo's plugin."""
