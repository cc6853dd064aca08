"""Missions, fences and rally points that a vehicle holds."""
