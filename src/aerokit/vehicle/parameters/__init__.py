"""The parameters of one autopilot."""
