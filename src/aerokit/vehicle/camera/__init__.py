"""Cameras: photos, video, lens, tracking, storage, streams, by MAVLink's camera protocol and older commands."""
