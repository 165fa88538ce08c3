"""Tests of the tasks, each against the installed Gymnasium."""
