"""Orders to a vehicle: their validity, their retries, and every action that moves or stops the vehicle."""
