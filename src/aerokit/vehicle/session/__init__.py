"""Communication with one vehicle: commands, message rates, transfers, detection of silence, signing keys."""
