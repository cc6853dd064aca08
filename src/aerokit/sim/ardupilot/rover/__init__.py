"""What is ArduRover's own: its modes, arming, failsafes, fence."""
