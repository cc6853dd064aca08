"""One MAVLink node: connections, cells and routes on the event loop."""
