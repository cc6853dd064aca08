"""Gimbals: where they point, who is in control of them, and orders to them (https://mavlink.io/en/services/gimbal_v2.html)."""
