"""Gimbals: attitude, control, and orders (https://mavlink.io/en/services/gimbal_v2.html)."""
