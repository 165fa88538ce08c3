"""Reproduction of the paper: arms over seeds, verdicts on reported numbers, redrawn figures."""
