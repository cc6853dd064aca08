"""``ComponentTalk``: what is sent to one component beside the autopilot, and heard of it."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from aerokit.autopilots import Autopilot, AutopilotVersion
from aerokit.mavlink import messages as m
from aerokit.runtime.cells import Source, StateCell
from aerokit.vehicle.talk.hearing import Hearing
from aerokit.vehicle.talk.rates import MessageRates
from aerokit.vehicle.talk.transfers import Transfers

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.runtime.bus import Detach
    from aerokit.runtime.connection import Connection
    from aerokit.vehicle.talk.commands import CommandSender
    from aerokit.vehicle.talk.talk import Talk

__all__ = ["ComponentTalk"]


class ComponentTalk:
    """The same as the vehicle's talk has for its autopilot, under another component id, and for as long as that."""

    def __init__(self, talk: Talk, component_id: int) -> None:
        self._talk = talk
        self.component_id: int = component_id
        self.system_id: int = talk.system_id
        self.connection: Connection = talk.connection
        self.commands: CommandSender = talk.commands
        self.on_reboot: list[Callable[[], None]] = talk.on_reboot
        self.rates: MessageRates = MessageRates(
            talk.connection, talk.commands, talk.system_id, component_id, {}
        )
        self.hearing: Hearing = Hearing(
            talk.connection, talk.system_id, component_id, self.rates, keep=talk.keep, at_close=talk.at_close
        )
        version: StateCell[AutopilotVersion] = talk.connection.new_cell(
            "version", f"AUTOPILOT_VERSION of component {component_id}"
        )
        talk.keep(version)
        self.transfers: Transfers = Transfers(
            talk.connection,
            talk.system_id,
            component_id,
            autopilot=Autopilot(talk.vehicle_type),
            version=version,
            background=talk.background,
            describe=self.describe_link,
            round_trip_s=lambda: talk.link_watch.round_trip_s,
        )
        autopilot, source = (
            self.transfers.autopilot,
            Source(talk.system_id, component_id, m.AutopilotVersion.NAME),
        )
        self.hearing.listen(
            m.AutopilotVersion, lambda message: version.set(autopilot.version_of(message), source)
        )
        for function in (self.rates.run, self.rates.watch):
            talk.background.start(function, f"aerokit {function.__qualname__} of component {component_id}")
        talk.on_reboot.append(self.rates.ask_again)
        talk.at_close(self._close)

    def at_close(self, *functions: Detach) -> None:
        """Have these called when the vehicle is let go."""
        self._talk.at_close(*functions)

    def describe_link(self) -> str:
        """One line on how well it is heard, for error texts."""
        heard_at = self.connection.heard_at(self.system_id, self.component_id)
        if heard_at == -math.inf:
            return f"component {self.component_id} of system {self.system_id} was never heard"
        age = self.connection.now() - heard_at
        signatures = self.connection.describe_signatures(self.system_id)
        why = f"{signatures}; " if signatures else ""
        return f"{why}last heartbeat of component {self.component_id} {age:.1f} s ago"

    def _close(self) -> None:
        self.transfers.is_closed = True
        self.rates.close()
