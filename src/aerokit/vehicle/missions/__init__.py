"""Missions, fences and rally points on a vehicle."""
