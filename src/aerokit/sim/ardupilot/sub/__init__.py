"""What is ArduSub's own: its modes, arming, failsafes."""
