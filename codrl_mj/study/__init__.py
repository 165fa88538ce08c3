"""Experiments of many runs: a grid that scales, statistics over seeds, the paper's experiments, the mismatch study."""
