"""Tests of motors on paper and of their command."""
