"""What is ArduCopter's own: its modes, missions, commands, arming, failsafes."""
