"""The study of what insures a policy against actuators that nobody has measured: docs/results/insurance_plan.md."""
