"""Vehicles as programs see them: connecting, state, actions, guided set-points, health."""
