"""This program as a MAVLink node: connections, state cells and routes."""
