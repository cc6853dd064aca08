"""`Bridge`: what all actions of one vehicle share, and how it begins and ends."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from aerokit.vehicle.commanding.arbiter import CommandArbiter
from aerokit.vehicle.commanding.cleanup import Holding, LateArming
from aerokit.vehicle.commanding.health import Health
from aerokit.vehicle.commanding.progress import Whereabouts
from aerokit.vehicle.commanding.sender import OrderSender
from aerokit.vehicle.state.states import States

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.autopilots import Autopilot
    from aerokit.connection.cells import StateCell
    from aerokit.connection.connection import Connection
    from aerokit.events import LinkReport
    from aerokit.vehicle.session.session import Talk
    from aerokit.vehicle.state.telemetry import Telemetry


class Bridge:
    """The talk with the vehicle, the arbiter of its orders, and what gives orders by them."""

    def __init__(self, talk: Talk) -> None:
        self.talk = talk
        self.arbiter: CommandArbiter = CommandArbiter(talk.connection.now, talk.telemetry)
        self.sender: OrderSender = OrderSender(talk, self.arbiter)
        self.holding: Holding = Holding(talk, self.arbiter, self.sender)
        self.late_arming: LateArming = LateArming(talk, self.arbiter, self.sender)
        self.health: Health = Health(talk)
        self.where: Whereabouts = Whereabouts(talk)
        self.on_finish: list[Callable[[], None]] = []
        """What is to be sent when the vehicle's block ends, without waiting."""
        talk.on_reboot.append(self.arbiter.note_reboot)

    async def finish(self) -> bool:
        """At the end of everything: what was given up is told to hold, as far as that can be; whether there was any."""
        for each in tuple(self.on_finish):
            each()
        self.holding.end_flights()
        is_given_up = self.holding.is_told_to_hold
        await self.holding.finish()
        await self.late_arming.finish()
        return is_given_up

    def describe_now(self) -> str:
        """What the vehicle does, as far as it was heard."""
        autopilot, telemetry = self.talk.autopilot, self.talk.telemetry
        hold, mode = autopilot.mode_for("hold", is_vtol=telemetry.is_vtol), telemetry.mode.latest
        disarmed = "disarmed" if telemetry.is_surely_disarmed else "perhaps armed"
        position = telemetry.position.latest
        height = None if position is None else position.altitude_relative_m
        return (
            f"{'holding in' if mode is not None and mode == hold else 'in'} {telemetry.mode_name},"
            f" {'still armed' if telemetry.is_armed else disarmed},"
            f" {'' if height is None else f'{height:.1f} m above home, '}heard {self.talk.heartbeat_age:.1f} s ago"
        )


class Part(States):
    """A part of :class:`aerokit.Vehicle`: some of its actions. Parts know the bridge, and not each other."""

    def __init__(self, bridge: Bridge) -> None:
        self._bridge, talk = bridge, bridge.talk
        self.connection: Connection = talk.connection
        """The connection it is reached by."""
        self.system_id: int = talk.system_id
        """MAVLink system id, 1–255."""
        self.component_id: int = talk.component_id
        """Component id of its autopilot, usually 1."""
        self.vehicle_type: int = talk.vehicle_type
        """MAV_TYPE of the first heartbeat (https://mavlink.io/en/messages/minimal.html#MAV_TYPE)."""
        self.autopilot: Autopilot = talk.autopilot
        """What differs between ArduPilot, PX4 and others."""
        self.telemetry: Telemetry = talk.telemetry
        """The state cells; most are properties of the vehicle too."""
        self.link_quality: StateCell[LinkReport] = talk.link_quality
        """Loss, delay and rates of the last second."""
        self._talk, self._arbiter, self._sender = talk, bridge.arbiter, bridge.sender
        self._holding, self._late_arming = bridge.holding, bridge.late_arming
        self._health, self._where = bridge.health, bridge.where

    def _cell_of(self, name: str) -> StateCell[Any]:
        return self.telemetry.cells[name]
