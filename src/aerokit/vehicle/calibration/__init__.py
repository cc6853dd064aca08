"""Calibration of sensors, radio and ESCs, step by step."""
