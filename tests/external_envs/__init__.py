"""Motors in environments of others."""
