"""Replays of episodes in three dimensions: one HTML file, to be turned, scrubbed and played at any speed."""

from codrl_mj.replay.motion import Motion, motion, motion_of_episode
from codrl_mj.replay.page import ReplayPart, replay, write_replay

__all__ = ["Motion", "ReplayPart", "motion", "motion_of_episode", "replay", "write_replay"]
