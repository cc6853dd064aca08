"""Corrections for satellite receivers (RTK): RTCM messages to the vehicle, and an NTRIP client that fetches them."""
