"""What is ArduPlane's own: its modes, missions, commands, arming, failsafes."""
