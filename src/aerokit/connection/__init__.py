"""Where sans-IO protocols meet the event loop."""
