"""The study of what an actuator costs: docs/results/plan.md says what is asked, and how it is answered."""
