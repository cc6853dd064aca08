"""Servers for MAVLink's protocols, without IO.

A server belongs to a `ServerHost`, which is a simulated vehicle or your program as a component (`aerokit.component`).
Subclasses in `aerokit.sim` imitate the behaviour of particular firmwares.
"""
