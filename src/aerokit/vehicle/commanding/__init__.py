"""Orders to a vehicle: their validity and retries, and the actions that move or stop the vehicle."""
