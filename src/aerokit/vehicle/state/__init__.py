"""State of a vehicle: each state is declared once, decoded on access, and kept in a cell."""
