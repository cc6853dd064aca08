"""Control drones over MAVLink from asyncio."""
