"""Servers of the MAVLink services, one for each protocol: messages and time in, messages out.

A server works on a `ServerHost`: a simulated vehicle, or this program as a component (`aerokit.component`). The habits
of single firmwares are subclasses in `aerokit.sim`.
"""
