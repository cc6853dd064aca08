"""Cameras: pictures, video, lens, tracking, storage and streams, by MAVLink's camera protocol and what was before."""
