"""What is on board beside the autopilot: cameras, gimbals, companion computers, receivers and others."""
