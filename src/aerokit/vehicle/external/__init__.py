"""Measurements and positions that a program supplies to a vehicle, and landing on a target by them."""
