"""Whether a motor can do a task."""
