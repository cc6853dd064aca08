"""Orders: their validity, what may be sent again, and every action that moves a vehicle or stops it."""
