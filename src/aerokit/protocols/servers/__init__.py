"""Servers for MAVLink's protocols, without IO.

A server belongs to a `ServerHost`: a simulated vehicle, or a program that acts as a component (`aerokit.component`).
Subclasses in `aerokit.sim` imitate the behaviour of particular firmwares.
"""
