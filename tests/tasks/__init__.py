"""Tests of the tasks against the installed Gymnasium."""
