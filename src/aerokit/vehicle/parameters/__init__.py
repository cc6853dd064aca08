"""Parameters of one autopilot: download, read, write, transactions."""
