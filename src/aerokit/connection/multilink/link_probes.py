"""``LinkProbes``: TIMESYNC requests over each link to each vehicle, and requests for its hardware id over new links.

https://mavlink.io/en/services/timesync.html, https://mavlink.io/en/messages/common.html#AUTOPILOT_VERSION
"""

from __future__ import annotations

import logging
import math
from typing import TYPE_CHECKING, NamedTuple

from aerokit.connection.multilink.vehicle_clock import ClockSample, HardwareId
from aerokit.events import DuplicateSender
from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavCmd, MavComponent

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from aerokit.connection.bus import Bus
    from aerokit.connection.multilink.link_choice import Candidate, LinkChoice
    from aerokit.mavlink.frame import Frame
    from aerokit.mavlink.message import Message
    from aerokit.transport.link import Peer

logger: logging.Logger = logging.getLogger("aerokit")

PROBE_INTERVAL_S = 0.5
IDLE_COSTLY_PROBE_INTERVAL_S = 5.0
TIMER_TOLERANCE_S = 0.05  # A probe may be sent this much early, because probe() is called only ten times a second.
MAX_PENDING = 256

# Maximum number of probes per second to systems without a vehicle object. Without this limit, a sender that forges
# system ids could saturate a slow radio.
UNATTACHED_RATE_HZ = 40.0

_AUTOPILOT = int(MavComponent.AUTOPILOT1)


class _Probe(NamedTuple):
    system_id: int
    link: int
    sent_at: float


class LinkProbes:
    """Probes each link to a system twice a second, or every five seconds if the link is costly and not in use.

    Answers are recorded in ``choices``. A link that leads to another vehicle with the same system id is reported.
    ``send(message, peer)`` sends a probe.
    """

    def __init__(
        self,
        names: Sequence[str],
        choices: Mapping[int, LinkChoice],
        bus: Bus,
        send: Callable[[Message, Peer], object],
    ) -> None:
        self._names, self._choices, self._bus, self._send = names, choices, bus, send
        self._pending: dict[int, _Probe] = {}  # the keys are the values of ts1
        self._probed_at: dict[tuple[int, int], float] = {}  # (system id, link) → time of its last probe
        # Token bucket that limits the probes to systems without a vehicle object.
        self._tokens, self._refilled_at = UNATTACHED_RATE_HZ, 0.0
        self._reported: set[tuple[int, int]] = set()  # (system id, link) of the reported second vehicles
        bus.require_frames(m.Timesync, m.AutopilotVersion)

    def probe(
        self,
        system_id: int,
        choice: LinkChoice,
        candidate: Candidate,
        peer: Peer,
        now: float,
        *,
        has_vehicle_object: bool,
    ) -> None:
        """Send a probe, and a request for the hardware id, if they are due.

        All systems without a vehicle object share a limited rate of probes.
        """
        # An unused costly link is probed rarely once it is known whether the link leads to the vehicle.
        is_idle = candidate.is_costly and candidate is not choice.used
        is_known = candidate.is_same_vehicle is not None
        interval_s = IDLE_COSTLY_PROBE_INTERVAL_S if is_idle and is_known else PROBE_INTERVAL_S
        key = system_id, candidate.link
        if now - self._probed_at.get(key, -math.inf) < interval_s - TIMER_TOLERANCE_S:
            return
        if not has_vehicle_object and not self._take_token(now):
            return
        self._probed_at[key] = now
        # The answer repeats `ts1`, which identifies the probe: our time in nanoseconds. The last three digits depend on
        # the system and the link, because several probes may be sent at the same time.
        ts1 = int(now * 1e9) // 1000 * 1000 + (system_id * len(self._names) + candidate.link) % 1000
        if ts1 <= 0 or ts1 in self._pending:
            return  # The number is invalid, or belongs to another pending probe. The next probe is sent as usual.
        if len(self._pending) >= MAX_PENDING:
            del self._pending[next(iter(self._pending))]
        self._pending[ts1] = _Probe(system_id, candidate.link, now)
        self._send(m.Timesync(tc1=0, ts1=ts1, target_system=system_id, target_component=_AUTOPILOT), peer)
        if choice.should_request_hardware(candidate, has_vehicle_object=has_vehicle_object):
            candidate.count_hardware_request()
            self._send(_hardware_request(system_id), peer)

    def record_answer(self, frame: Frame, link: int) -> bool:
        """Record the autopilot's answer to a probe over this link. Return True if the TIMESYNC answers any probe."""
        message = self._bus.dialect.decode(frame)
        is_request = isinstance(message, m.Timesync) and not message.tc1  # In an answer, tc1 is the vehicle's time.
        if not isinstance(message, m.Timesync) or is_request or message.ts1 not in self._pending:
            return False
        if frame.component_id != _AUTOPILOT:
            return True  # A companion computer has answered, whose clock is not the vehicle's.
        now = frame.received_at
        round_trip_s = self._round_trip_of(message, frame.system_id, link, now)
        choice = self._choices.get(frame.system_id)
        if round_trip_s is not None and choice is not None and link in choice.candidates:
            # The vehicle read its clock at about the middle of the round trip.
            sample = ClockSample(now - round_trip_s / 2, message.tc1 / 1e9, round_trip_s)
            choice.record_answer(link, sample, now)
            self._report_other_vehicle(frame, choice.candidates[link])
        return True

    def record_hardware(self, frame: Frame, link: int) -> None:
        """Record the hardware id if the frame is an AUTOPILOT_VERSION of an autopilot."""
        if frame.message_id != m.AutopilotVersion.ID or frame.component_id != _AUTOPILOT:
            return
        choice = self._choices.get(frame.system_id)
        message = self._bus.dialect.decode(frame)
        if isinstance(message, m.AutopilotVersion) and choice is not None and link in choice.candidates:
            choice.record_hardware(link, HardwareId.from_message(message))
            for candidate in choice.candidates.values():
                self._report_other_vehicle(frame, candidate)

    def _take_token(self, now: float) -> bool:
        self._tokens = min(UNATTACHED_RATE_HZ, self._tokens + UNATTACHED_RATE_HZ * (now - self._refilled_at))
        self._refilled_at = now
        if self._tokens < 1:
            return False
        self._tokens -= 1
        return True

    def _round_trip_of(self, answer: m.Timesync, system_id: int, link: int, now: float) -> float | None:
        """Return the seconds from the probe to its answer, or None if another system or another link answered."""
        probe = self._pending[answer.ts1]
        if (probe.system_id, probe.link) != (system_id, link):
            return None
        del self._pending[answer.ts1]
        return max(0.0, now - probe.sent_at)

    def _report_other_vehicle(self, frame: Frame, candidate: Candidate) -> None:
        """Report once that the link seems to lead to another vehicle with the same system id."""
        key = frame.system_id, candidate.link
        if candidate.is_same_vehicle is not False:
            self._reported.discard(key)  # If the link leads to another vehicle later, that is reported again.
        elif key not in self._reported:
            self._reported.add(key)
            logger.warning(
                "another vehicle with system id %d was received over %s (its %s differs): its frames are refused",
                frame.system_id,
                self._names[candidate.link],
                "hardware id in AUTOPILOT_VERSION" if candidate.is_other_hardware else "clock",
            )
            self._bus.publish(DuplicateSender(frame.received_at, frame.system_id, frame.component_id))


def _hardware_request(system_id: int) -> m.CommandLong:
    # PX4 acknowledges a command over each of its ports (mavlink_main.cpp, vehicle_command_ack). The ack of this request
    # may therefore be taken for that of another REQUEST_MESSAGE. This does no harm, because actions use other commands,
    # and `request_message` waits for the message itself.
    return m.CommandLong(
        system_id, _AUTOPILOT, MavCmd.REQUEST_MESSAGE, confirmation=0, param1=float(m.AutopilotVersion.ID),
        param2=0, param3=0, param4=0, param5=0, param6=0, param7=0,
    )  # fmt: skip
