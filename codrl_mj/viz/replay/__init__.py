"""Interactive 3D replays of episodes: one HTML file, to be turned, scrubbed and played."""

from codrl_mj.viz.replay.page import (
    SCRIPT,
    Motion,
    library_script,
    motion,
    motion_of_episode,
    replay_html,
    write_replay,
)

__all__ = [
    "SCRIPT",
    "Motion",
    "library_script",
    "motion",
    "motion_of_episode",
    "replay_html",
    "write_replay",
]
