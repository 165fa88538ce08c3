"""One suite of contracts for all environments."""
