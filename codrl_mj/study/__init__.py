"""Experiments of many runs: a grid that scales, inference over seeds, the paper's experiments, what actuators cost."""
