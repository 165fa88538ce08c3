"""Replays of episodes in three dimensions: one HTML file, to be turned, scrubbed and played at any speed."""

from codrl_mj.viz.replay.page import (
    SCRIPT,
    Motion,
    library,
    motion,
    motion_of_episode,
    replay,
    write_replay,
)

__all__ = ["SCRIPT", "Motion", "library", "motion", "motion_of_episode", "replay", "write_replay"]
