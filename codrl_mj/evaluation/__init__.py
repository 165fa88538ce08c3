"""Whole episodes, and their reduction to measures."""

from codrl_mj.evaluation.episodes import (
    Episode,
    RandomPolicy,
    check_episodes,
    check_policy,
    load_episode,
    run_episodes,
    save_episode,
)
from codrl_mj.evaluation.evaluate import MEASURES, Evaluation, at_goal, evaluate, summarize
from codrl_mj.evaluation.measures import Interval, Quartiles, bootstrap_mean

__all__ = [
    "MEASURES",
    "Episode",
    "Evaluation",
    "Interval",
    "Quartiles",
    "RandomPolicy",
    "at_goal",
    "bootstrap_mean",
    "check_episodes",
    "evaluate",
    "load_episode",
    "check_policy",
    "run_episodes",
    "save_episode",
    "summarize",
]
