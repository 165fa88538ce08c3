"""Study of protecting a policy from unmeasured actuators: docs/results/insurance_plan.md."""
