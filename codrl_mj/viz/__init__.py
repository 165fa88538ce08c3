"""Visualization of episodes and results: films, replays, live views and pages."""
