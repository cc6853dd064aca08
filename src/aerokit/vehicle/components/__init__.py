"""Components other than the autopilot: cameras, gimbals, companion computers, receivers and others."""
