"""``LinkChoice``: selects a link to a system, and checks which links lead to the same vehicle. Sans-IO."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from aerokit.connection.multilink.vehicle_clock import VehicleClock

if TYPE_CHECKING:
    from aerokit.connection.multilink.vehicle_clock import ClockSample, HardwareId

# Probes are answered twice a second, so a link counts as dead after this silence.
PROBED_TIMEOUT_S = 1.0

# A costly link, or a link whose probes are not answered, counts as dead after this silence (two missing heartbeats).
UNPROBED_TIMEOUT_S = 2.5

# This many consecutive matching clock samples prove that a second link leads to the same vehicle.
MIN_CLOCK_MATCHES = 3

# A request for the hardware id counts as unanswered after this many later answers to TIMESYNC probes.
MAX_ANSWERS_WITHOUT_HARDWARE = 3

MAX_HARDWARE_REQUESTS = 20

# This many frames that arrived over a second link and over the link in use prove that both lead to the same vehicle.
MIN_COPIES = 3


class Candidate:
    """One link over which a system was received: its quality, and the evidence that it leads to the vehicle."""

    def __init__(self, link: int, *, is_costly: bool, now: float) -> None:
        self.link = link
        self.is_costly = is_costly
        self.received_at: float = now
        """Time of the last frame received from the system over the link. May be 0.1 s too late."""
        self.answered_at: float = -math.inf
        """Time of the last answer to a probe."""
        self.copied_at: float = -math.inf
        """Time of the last frame that was received both over this link and over the link in use."""
        self.is_available: bool = True
        """True while the link is open."""
        self.is_stalled: bool = False
        """True while written data stays in this machine's buffers."""
        self.loss: float | None = None
        """Fraction of frames lost, 0 to 1, mostly of the last dozen frames. None if unknown."""
        self.round_trip_s: float | None = None
        """Smoothed round-trip time of the probes; None before the first answer."""
        self.is_same_vehicle: bool | None = None
        """True if the link leads to the vehicle, False if to another one with the same system id; None if unknown."""
        self.was_same_vehicle: bool = False
        """True if :attr:`is_same_vehicle` was True earlier, e.g. before the vehicle rebooted."""
        self.hardware: HardwareId | None = None
        """Hardware id received over the link; None if none was received."""
        self.is_other_hardware: bool = False
        """True if :attr:`hardware` is another vehicle's id. A matching clock or copies then do not count."""
        # Numbers of requests for the hardware id, and of TIMESYNC answers since the first request.
        self._hardware_requests = self._answers_since_request = 0
        # How often the clock matched and did not match in succession, and number of copies. A reboot resets them.
        self._clock_matches = self._clock_mismatches = self._copies = 0
        self._last_counts = (0, 0)  # numbers of frames received and lost at the last call of `record_counts`

    def record_counts(self, received: int, lost: int, now: float) -> None:
        received_before, lost_before = self._last_counts
        self._last_counts = received, lost
        if received > received_before:
            self.received_at = now  # The frame arrived after the previous call, up to 0.1 s ago.
        # A total is smaller than before if its counters were replaced, e.g. because a peer was evicted.
        new_received, new_lost = max(0, received - received_before), max(0, lost - lost_before)
        if new_received or new_lost:
            new_loss = new_lost / (new_received + new_lost)
            weight = 1 - 0.85 ** (new_received + new_lost)  # The last dozen frames determine most of the average.
            self.loss = new_loss if self.loss is None else self.loss + weight * (new_loss - self.loss)

    def record_round_trip(self, seconds: float, now: float) -> None:
        self.answered_at = now
        self.received_at = now
        average_s = self.round_trip_s
        self.round_trip_s = seconds if average_s is None else 0.7 * average_s + 0.3 * seconds

    def record_clock(self, matches: bool, *, awaits_hardware: bool) -> None:
        """Record whether the time in a probe's answer matches the vehicle's clock.

        With ``awaits_hardware``, matches do not count yet, because the link's hardware id is still awaited.
        """
        if matches:
            self._clock_matches, self._clock_mismatches = self._clock_matches + 1, 0
        else:
            self._clock_matches, self._clock_mismatches = 0, self._clock_mismatches + 1
        # The hardware id is stronger evidence than the clock, so matches do not count while it is awaited or differs.
        do_matches_count = not awaits_hardware and not self.is_other_hardware
        if self._clock_matches >= MIN_CLOCK_MATCHES and do_matches_count:
            self.is_same_vehicle = True
        elif self._clock_mismatches >= MIN_CLOCK_MATCHES:
            self._mark_as_other_vehicle()

    def record_copy(self, now: float) -> None:
        """Count a frame that arrived over this link and the link in use.

        Call this only for frames with a time since boot. Other frames of two vehicles may be equal.
        """
        self.copied_at = now
        self._copies += 1
        if self._copies >= MIN_COPIES and not self.is_other_hardware:
            self.is_same_vehicle = True

    def on_reboot(self) -> None:
        """Discard the evidence that the link leads to the vehicle."""
        if self.is_same_vehicle:
            self.is_same_vehicle, self.was_same_vehicle = None, True
        self.is_other_hardware = False
        self.hardware = None
        self._hardware_requests = self._answers_since_request = 0
        self._clock_matches = self._clock_mismatches = self._copies = 0

    @property
    def needs_hardware(self) -> bool:
        """True if the hardware id is unknown, and further requests over this link may be answered."""
        is_answering = self.answered_at > -math.inf
        return self.hardware is None and is_answering and self._hardware_requests < MAX_HARDWARE_REQUESTS

    def count_hardware_request(self) -> None:
        self._hardware_requests += 1

    @property
    def is_hardware_pending(self) -> bool:
        """True while an answer to a request for the hardware id can be expected."""
        return self._hardware_requests > 0 and self._answers_since_request < MAX_ANSWERS_WITHOUT_HARDWARE

    def record_hardware(self, *, is_other: bool) -> None:
        """Record whether the hardware id reported over this link differs from that of the vehicle."""
        if is_other:
            self._mark_as_other_vehicle()
            self.was_same_vehicle = False
        elif self.is_other_hardware:  # Until now the link led to another vehicle.
            self.is_same_vehicle = None
        self.is_other_hardware = is_other

    def count_answer(self) -> None:
        if self._hardware_requests:
            self._answers_since_request += 1

    def reset_mismatches(self) -> None:
        self._clock_mismatches = 0

    def _mark_as_other_vehicle(self) -> None:
        self.was_same_vehicle = self.was_same_vehicle or self.is_same_vehicle is True
        self.is_same_vehicle = False

    def is_alive(self, now: float) -> bool:
        is_answering = now - self.answered_at <= 2 * UNPROBED_TIMEOUT_S
        timeout_s = PROBED_TIMEOUT_S if is_answering and not self.is_costly else UNPROBED_TIMEOUT_S
        return self.is_available and not self.is_stalled and now - self.received_at <= timeout_s

    def failure(self) -> str:
        """Return why this link cannot be used any more, for events."""
        if self.is_other_hardware:
            return "another vehicle"
        if not self.is_available:
            return "lost"
        return "stalled" if self.is_stalled else "silent"

    @property
    def cost_s(self) -> float:
        """Expected seconds for a command and its answer, including retries after losses."""
        loss = min(0.9, self.loss or 0.0)  # A loss of 1 would make the cost infinite.
        round_trip_s = 0.1 if self.round_trip_s is None else self.round_trip_s
        # Adding 0.05 s makes links with round trips of a few milliseconds cost about the same. The exponent is 2,
        # because both the command and its answer must arrive.
        return (round_trip_s + 0.05) / (1 - loss) ** 2


# Two links count as carrying the same stream for this time after a frame was received over both.
SAME_STREAM_MAX_AGE_S = 5.0

# A link that works is replaced only if another link costs less than this fraction of its cost for at least
# MIN_BETTER_S.
MAX_COST_RATIO = 0.5
MIN_BETTER_S = 3.0

JITTER_S = 0.05  # assumed variation of the transit time over a link

# A switch to a better link waits until no command is in transit, but not longer than this, because during a continuous
# stream of set-points a command is always in transit.
MAX_SWITCH_DELAY_S = 10.0


class LinkChoice:
    """The links to one system, and the link in use.

    If the system has an autopilot, a second link is used only after a matching clock or equal frames have proved that
    it leads to the same vehicle. Until then, frames of the second link are refused, and no command is sent over it. A
    link with a different hardware id is refused even if the clock matches.
    """

    def __init__(self, *, has_autopilot: bool) -> None:
        self.has_autopilot: bool = has_autopilot
        self.candidates: dict[int, Candidate] = {}  # by index of the link
        self.clock: VehicleClock = VehicleClock()
        self.hardware: HardwareId | None = None
        """Hardware id of the vehicle, received over a link while it was the link in use; None if unknown."""
        # Index of the link whose next hardware id replaces `hardware` even if the two differ. This is the link that
        # delivered `hardware` or, after a reboot, the link over which the reboot was detected. None at first.
        self._hardware_link: int | None = None
        self.used: Candidate | None = None
        """The link in use; None before the first choice."""
        self.previous: Candidate | None = None
        """The link in use before the last switch. Answers may still arrive over it."""
        self.switched_at: float = -math.inf  # time of the last switch to another link
        self.fresh_after: float = -math.inf
        """Telemetry that arrives before this time may be older than the last telemetry of the previous link."""
        self._better: Candidate | None = None  # link that is better than the link in use, since `_better_since`
        self._better_since = 0.0
        self._command_at = -math.inf  # time of the last command to the system

    def record_heartbeat(self, link: int, now: float, *, is_costly: bool) -> Candidate:
        candidate = self.candidates.get(link)
        if candidate is None:
            candidate = self.candidates[link] = Candidate(link, is_costly=is_costly, now=now)
        candidate.received_at = now
        return candidate

    def record_autopilot(self, candidate: Candidate) -> None:
        """Record that the autopilot's first heartbeat arrived over this link."""
        self.has_autopilot = True
        if candidate is not self.used:
            self.used = None  # The link used so far leads to another component only, e.g. a camera.
            self.candidates = {candidate.link: candidate}  # `choose` then selects this link.

    def record_answer(self, link: int, sample: ClockSample, now: float) -> None:
        """Record a probe's answer, which contains the time of the vehicle's clock."""
        candidate = self.candidates[link]
        # True if the link in use has not answered since the previous answer over this link. This is checked before
        # `record_round_trip` replaces the time of that answer.
        is_used_silent = self.used is not None and self.used.answered_at < candidate.answered_at
        candidate.record_round_trip(sample.round_trip_s, now)
        if candidate is self.used:
            self._update_clock(link, sample)
            return
        candidate.count_answer()
        matches = self.clock.matches(sample)
        if not matches and is_used_silent:
            # While the link in use is silent, the vehicle may have rebooted, so a different clock does not prove that
            # this is another vehicle. Only a matching hardware id counts; otherwise the answer is ignored (None).
            matches = True if self._is_confirmed_by_hardware(candidate, now) else None
        if matches is not None:
            candidate.record_clock(matches, awaits_hardware=self._awaits_hardware(candidate))

    def _update_clock(self, link: int, sample: ClockSample) -> None:
        if not self.clock.add(sample):
            # The clock jumped, so the vehicle has rebooted or was replaced by another vehicle. The next hardware id
            # over this link is therefore accepted as the vehicle's id.
            self._hardware_link = link
            for candidate in self.candidates.values():
                candidate.on_reboot()
        elif self.clock.was_paused:
            # While a simulation was paused, its answers over other links did not match either. Forget these mismatches.
            for candidate in self.candidates.values():
                candidate.reset_mismatches()

    def record_hardware(self, link: int, hardware: HardwareId) -> None:
        candidate = self.candidates[link]
        if hardware.has_value or candidate.hardware is None:  # An empty id does not replace a known one.
            candidate.hardware = hardware
        if candidate is self.used:
            self._adopt_hardware(candidate)
        for compared in self.candidates.values():
            if self.hardware is not None and compared.hardware is not None:
                compared.record_hardware(is_other=self.hardware.contradicts(compared.hardware))

    def may_be_used(self, candidate: Candidate) -> bool:
        if candidate.is_other_hardware:
            return False
        needs_proof = self.has_autopilot and self.used not in (None, candidate)
        return not needs_proof or candidate.is_same_vehicle is True

    def carries_same_stream(self, candidate: Candidate, now: float) -> bool:
        """Return True if equal frames have recently arrived over this link and over the link in use.

        If ``candidate`` is the link in use, return True if equal frames have recently arrived over it and another link.
        """
        return now - candidate.copied_at <= SAME_STREAM_MAX_AGE_S

    def choose(self, now: float) -> str | None:
        """Select the link to use. Return the reason if it changes, otherwise None."""
        usable = filter(self.may_be_used, self.candidates.values())
        alive = [candidate for candidate in usable if candidate.is_alive(now)]
        alive.sort(key=lambda candidate: (candidate.is_costly, candidate.cost_s))
        if not alive:
            return None
        best, used = alive[0], self.used
        if used is None:
            return self._switch_to(best, "first heard", now)
        if used not in alive:
            return self._switch_to(best, used.failure(), now)
        is_better = best.is_costly < used.is_costly or best.cost_s < MAX_COST_RATIO * used.cost_s
        # A better link replaces the link in use only after it has stayed the best for MIN_BETTER_S.
        if best is used or not is_better:
            self._better = None
        elif best is not self._better:
            self._better, self._better_since = best, now
        elif now - self._better_since >= MIN_BETTER_S and not self._must_delay_switch(used, now):
            return self._switch_to(best, "cheaper" if best.is_costly < used.is_costly else "better", now)
        return None

    def record_command(self, now: float) -> None:
        self._command_at = now

    def should_request_hardware(self, candidate: Candidate, *, has_vehicle_object: bool) -> bool:
        if candidate is not self.used:
            return candidate.needs_hardware and not candidate.is_same_vehicle
        # Over the link in use, the vehicle object requests the id itself.
        has_other_links = len(self.candidates) > 1  # With a single link, there is no other id to compare with.
        return candidate.needs_hardware and has_other_links and not has_vehicle_object

    def _is_confirmed_by_hardware(self, candidate: Candidate, now: float) -> bool:
        is_same = (
            self.hardware is not None and candidate.hardware is not None and self.hardware.confirms(candidate.hardware)
        )
        is_only_link = [other for other in self.candidates.values() if other.is_alive(now)] == [candidate]
        return candidate.was_same_vehicle and is_same and is_only_link

    def _awaits_hardware(self, candidate: Candidate) -> bool:
        can_compare_ids = self.hardware is not None and candidate.hardware is not None
        return candidate.is_hardware_pending and not can_compare_ids

    def _adopt_hardware(self, used: Candidate) -> None:
        """Make the hardware id of the link in use the vehicle's id."""
        hardware = used.hardware
        if hardware is None or not hardware.has_value:
            return
        # The vehicle's id from another link is kept if the new id contradicts it: this link leads to another vehicle.
        is_from_same_link = self._hardware_link == used.link
        if self.hardware is None or is_from_same_link or not self.hardware.contradicts(hardware):
            self.hardware, self._hardware_link = hardware, used.link

    def _must_delay_switch(self, used: Candidate, now: float) -> bool:
        """Return True while a command over the better link could overtake the last command."""
        transit_s = (used.round_trip_s or 0.0) + JITTER_S
        waited_s = now - self._better_since - MIN_BETTER_S
        return now - self._command_at <= transit_s and waited_s <= MAX_SWITCH_DELAY_S

    def _switch_to(self, chosen: Candidate, reason: str, now: float) -> str:
        previous = self.used
        if previous is not None:
            # Until `fresh_after`, the new link may deliver telemetry that is older than the previous link's last frame.
            extra_transit_s = ((chosen.round_trip_s or 0.0) - (previous.round_trip_s or 0.0)) / 2
            self.fresh_after = previous.received_at + extra_transit_s + JITTER_S
            # The chosen link was compared with the previous one (see `may_be_used`). Both therefore lead to the same
            # vehicle, unless their hardware ids differ.
            previous.is_same_vehicle = not previous.is_other_hardware
        self.previous = previous
        self.used = chosen
        self.switched_at = now
        self._better = None
        self._adopt_hardware(chosen)
        return reason
