"""Orders: who steers, what may be sent again, and every action that moves a vehicle or keeps it."""
