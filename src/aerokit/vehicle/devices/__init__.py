"""Outputs and devices of a vehicle: servos, relays, grippers, winches, tunes, failures, the shell."""
