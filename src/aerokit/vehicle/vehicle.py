"""``Vehicle``: one drone, rover, boat or submarine, as its program sees it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import anyio

from aerokit.arguments import checks_arguments
from aerokit.errors import CommandRejected, CommandTimeout
from aerokit.vehicle.files.files import Files
from aerokit.vehicle.files.logs import Logs
from aerokit.vehicle.orders.flight import FlightActions
from aerokit.vehicle.orders.guided import Guided
from aerokit.vehicle.parameters.parameters import Parameters
from aerokit.vehicle.plans.fence import FenceControl
from aerokit.vehicle.plans.held import PlanContext
from aerokit.vehicle.plans.mission import MissionControl
from aerokit.vehicle.plans.rally import RallyControl
from aerokit.vehicle.talk.signing import set_up_signing

if TYPE_CHECKING:
    from collections.abc import Mapping

    from aerokit.mavlink.message import Message
    from aerokit.mavlink.messages import Heartbeat
    from aerokit.mavlink.signing import Signing
    from aerokit.runtime.connection import Connection

__all__ = ["Vehicle"]

REQUEST_MESSAGE = 512
AUTOPILOT_VERSION, HOME_POSITION, GPS_GLOBAL_ORIGIN, AVAILABLE_MODES = 148, 242, 49, 435
ASK_AGAIN_S = 3.0
EAGER_REQUESTS, EAGER_S = 4, 0.3


@checks_arguments
class Vehicle(FlightActions):
    """One vehicle. Coroutines talk to it, properties never do; everything has a deadline and can be cancelled.

    Made by :func:`aerokit.connect`. State is in cells (``vehicle.position.value``, ``.age``, ``.fresh(within=1)``,
    ``await vehicle.mode.wait_until(...)``), SI units and degrees, the unit in the name.
    """

    def __init__(
        self, connection: Connection, system_id: int, component_id: int, heartbeat: Heartbeat
    ) -> None:
        super().__init__(connection, system_id, component_id, heartbeat)
        self.guided = Guided(self)
        """Set-point streams: velocity, position, acceleration, attitude."""
        self.files = Files(self._transfers)
        """The files on it, by MAVFTP."""
        self.logs = Logs(self._transfers, self.files)
        """Its flight logs."""
        self.parameters = Parameters(self._transfers, self.files)
        """The autopilot's parameters: download, get, set, transactions, what was changed."""
        self._detach.append(self.parameters._attach())
        plans = PlanContext(self, getattr(self, "files", None))
        self.mission = MissionControl(plans)
        """The mission it holds: upload, download, start, pause, wait until it is finished."""
        self.fence = FenceControl(plans)
        """The fence it holds."""
        self.rally = RallyControl(plans)
        """The rally points it holds."""

    def __repr__(self) -> str:
        return f"<Vehicle {self.system_id}/{self.component_id} {self.autopilot.firmware}, {self.describe_link()}>"

    async def setup_signing(self, signing: Signing | None, *, timeout: float = 5.0) -> None:
        """Give the vehicle a key (SETUP_SIGNING), and sign and check with it from then on; None takes the key away.

        **The key travels in clear**: do this over a cable or a link that nobody listens to. Returns when the
        vehicle's frames are signed with the key (None: when they are not signed any more); until then what was in use
        remains in use. All on this connection need the key then, or ``signing.allow_unsigned``. Cancelled, the vehicle
        may have taken the key all the same. See docs/signing.md.

        Args:
            signing: the key, as for ``connect(signing=…)``.
            timeout: seconds until the vehicle uses it.

        Raises:
            NotSupported: we or the vehicle speak MAVLink 1, which has no signatures. Nothing was sent.
            OperationRejected: it is armed, or not known to be disarmed. Nothing was sent.
            OperationTimeout: it went on as before; the text has what it said.
            BusyError: another vehicle on this connection is just being given a key. Nothing was sent.
        """
        await set_up_signing(self, signing, timeout)

    # ------------------------------------------------------------------------------ inside

    def _on_reboot(self) -> None:
        super()._on_reboot()
        self.mission._forget()
        self.parameters._forget()

    def _start(self, heartbeat: Heartbeat, rates: Mapping[type[Message], float] | None) -> None:
        self.telemetry.receive(heartbeat)
        for message_type, hz in (self.telemetry.default_rates if rates is None else rates).items():
            self._rates.want(message_type, hz, is_optional=rates is None)
        for function in (self._rates.run, self._rates.watch, self._run_link_watch, self._learn_constants):
            self._background.start(function, f"aerokit {function.__qualname__}")

    async def _run_link_watch(self) -> None:
        await self._link_watch.run(self._on_second)

    def _on_second(self) -> None:
        self._watch.check()
        self.telemetry.expire(self.connection.now())

    async def _learn_constants(self) -> None:
        """Ask for what is not streamed, until it is known; a reboot makes it unknown again."""
        asked_for_modes = False
        await self._learn_version()
        while self.connection.is_open:
            for message_id, cell in (
                (AUTOPILOT_VERSION, self.telemetry.version),
                (HOME_POSITION, self.telemetry.home),
                (GPS_GLOBAL_ORIGIN, self.telemetry.origin),
            ):
                if not cell.is_known:
                    await self._request(message_id)
            if not asked_for_modes:
                asked_for_modes = await self._request(AVAILABLE_MODES)
            await anyio.sleep(ASK_AGAIN_S)

    async def _learn_version(self) -> None:
        """The first transfer waits for what the vehicle can do: ask eagerly, an answer may get lost behind its ack."""
        version = self.telemetry.version
        for _ in range(EAGER_REQUESTS):
            if version.is_known:
                return
            await self._request(AUTOPILOT_VERSION, attempt_timeout=EAGER_S)
            with anyio.move_on_after(EAGER_S):
                await version.wait_until(lambda _: True)

    async def _request(self, message_id: int, *, attempt_timeout: float = 1.0) -> bool:
        """Ask for one message once; whether there was an answer, also that the vehicle does not have it."""
        try:
            await self._commands.send_long(
                REQUEST_MESSAGE, message_id, attempts=2, attempt_timeout=attempt_timeout
            )
        except CommandTimeout:
            return False
        except CommandRejected:
            pass
        return True
