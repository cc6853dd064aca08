"""Several links to the same vehicles: duplicates, the choice of a link, and routes."""
