"""Tests of the disturbances."""
