"""What a vehicle is heard to be: each state declared once, decoded when somebody looks, kept in a cell."""
