"""Policies that are taken out of the simulator."""
