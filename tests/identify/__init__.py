"""Motors from their bench logs."""
