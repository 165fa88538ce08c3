"""Tests that run other simulators: `make simulators` installs them."""
