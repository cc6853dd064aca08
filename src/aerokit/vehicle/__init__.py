"""Vehicles: connecting, state, actions, guided set-points, health."""
