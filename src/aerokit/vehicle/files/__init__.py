"""Files and flight logs on a vehicle."""
