"""The buzzer of a simulated ArduCopter."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aerokit.mavlink.messages import PlayTune

if TYPE_CHECKING:
    from aerokit.sim.channel import Channel
    from aerokit.sim.vehicle import SimulatedVehicle

__all__ = ["hear_tunes"]

_LONGEST = 99


def hear_tunes(vehicle: SimulatedVehicle) -> list[str]:
    """Have it take PLAY_TUNE from now on; the list grows by what is played."""
    played: list[str] = []

    def play(tune: PlayTune, _: Channel) -> None:
        played.append((tune.tune + tune.tune2)[:_LONGEST])

    vehicle.on(PlayTune, play)
    return played
