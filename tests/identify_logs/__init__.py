"""Reading, checking, planning and simulating bench logs."""
