"""Talking to one vehicle: commands, rates, transfers, silence, keys."""
