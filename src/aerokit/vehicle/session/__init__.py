"""Communication with one vehicle: commands, message rates, transfers, silence, signing keys."""
