"""Study of the cost of an actuator; docs/results/plan.md has its questions and methods."""
