"""Drone shows: timed trajectories as values and files, and flying them on a common clock."""
