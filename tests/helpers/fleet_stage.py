"""A fleet of simulated copters on one or several networks, on virtual time, with recorders of received messages."""

from __future__ import annotations

from collections.abc import AsyncIterator, Sequence
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass
from typing import Any

from flight_harness import Wire

from aerokit import messages as m
from aerokit.connection.bus import Subscription
from aerokit.fleets.events import FleetEvent
from aerokit.fleets.fleet import Fleet
from aerokit.fleets.opening import fleet
from aerokit.mavlink.enums import CopterMode, MavCmd
from aerokit.sim import SimulatedCopter, simulated_link

HOME = (47.3977, 8.5456, 488.0)


@dataclass
class Stage:
    """Simulated copters by member name."""

    fleet: Fleet
    copters: dict[str, SimulatedCopter]
    wires: dict[str, Wire]
    events_subscription: Subscription[FleetEvent]

    def mode_of(self, name: str) -> str:
        return self.copters[name].mode.name

    @property
    def modes(self) -> dict[str, str]:
        return {name: copter.mode.name for name, copter in self.copters.items()}

    def orders_to(self, name: str) -> list[tuple[float, m.CommandLong | m.CommandInt]]:
        """Return the state-changing commands that the member received, with their times."""
        network, _, number = name.partition("/")
        return [
            (at, message)
            for at, message in self.wires[network].sent
            if isinstance(message, (m.CommandLong, m.CommandInt))
            and message.target_system == int(number)
            and message.command in ORDERS
        ]

    def modes_ordered(self, name: str) -> list[str]:
        return [
            CopterMode(int(command.param2)).name
            for _, command in self.orders_to(name)
            if command.command == MavCmd.DO_SET_MODE
        ]

    def clear(self) -> None:
        for wire in self.wires.values():
            wire.clear()

    def events(self, kind: type[FleetEvent] = FleetEvent) -> list[Any]:
        """Events until now."""
        found = []
        while (event := self.events_subscription.get_nowait()) is not None:
            found.append(event)
        return [event for event in found if isinstance(event, kind)]

    async def take_off(self, altitude_m: float = 10.0) -> None:
        """Wait until all members are ready, arm them, take off, and clear the recorders."""
        (await self.fleet.wait_ready()).raise_for_errors()
        (await self.fleet.arm()).raise_for_errors()
        (await self.fleet.take_off(altitude_m)).raise_for_errors()
        self.events()
        self.clear()

    def pilot_takes(self, name: str, mode: int = CopterMode.LOITER) -> None:
        """Change the mode by the remote control, with the throttle stick in the middle."""
        copter = self.copters[name]
        copter.rc[2] = 1500
        assert copter.set_mode(mode)


ORDERS = (
    MavCmd.DO_SET_MODE,
    MavCmd.NAV_TAKEOFF,
    MavCmd.DO_REPOSITION,
    MavCmd.COMPONENT_ARM_DISARM,
    MavCmd.MISSION_START,
    MavCmd.NAV_LAND,
    MavCmd.NAV_RETURN_TO_LAUNCH,
)


@asynccontextmanager
async def open_stage(
    count: int = 3, *, networks: Sequence[str] = ("north",), spacing_m: float = 10.0, **options: Any
) -> AsyncIterator[Stage]:
    """Create ``count`` copters with ids 1, 2, 3 … on each network, side by side to the east."""
    copters: dict[str, SimulatedCopter] = {}
    wires: dict[str, Wire] = {}
    metre = 1 / 75_300  # degrees of longitude at home
    async with AsyncExitStack() as stack:
        for row, network in enumerate(networks):
            own = [
                SimulatedCopter(
                    system_id=number + 1,
                    boot_time_s=0.0,
                    home=(HOME[0] + row * 2e-4, HOME[1] + number * spacing_m * metre, HOME[2]),
                    seed=10 * row + number,
                )
                for number in range(count)
            ]
            copters |= {f"{network}/{name.system_id}": name for name in own}
            wires[network] = Wire(await stack.enter_async_context(simulated_link(own)))
        options.setdefault("count", len(copters))
        async with fleet(dict(wires), **options) as opened:
            with opened.events(FleetEvent) as events:
                yield Stage(opened, copters, wires, events)
