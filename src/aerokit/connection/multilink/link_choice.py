"""``LinkChoice``: selects a link to a system, and checks which links lead to the same vehicle. Sans-IO."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from aerokit.connection.multilink.vehicle_clock import VehicleClock

if TYPE_CHECKING:
    from aerokit.connection.multilink.vehicle_clock import HardwareId

# Silence after which a link is not alive. Probes are answered twice a second.
PROBED_TIMEOUT_S = 1.0

# Silence (two missing heartbeats) after which a link without answers to probes, or a costly link, counts as dead.
UNPROBED_TIMEOUT_S = 2.5

# Consecutive matching clock samples that prove that a second link leads to the same vehicle.
MIN_CLOCK_MATCHES = 3

# A vehicle that answers this many TIMESYNC probes, but not the request for its hardware id, has none to report.
MAX_TIMES_WITHOUT_HARDWARE = 3

MAX_HARDWARE_REQUESTS = 20

# This many frames received both over a link and over the link in use prove that both lead to the same vehicle.
MIN_COPIES = 3


class Candidate:
    """One link to one system."""

    def __init__(self, link: int, *, is_costly: bool, now: float) -> None:
        self.link = link
        self.is_costly = is_costly
        self.received_at: float = now
        """Time of the last frame of the system over the link."""
        self.answered_at: float = -math.inf
        """Time of the last answer to a probe."""
        self.shared_at: float = -math.inf
        """Time of the last frame that was received both over this link and over the link in use."""
        self.is_available: bool = True
        """True while the link is open."""
        self.is_stalled: bool = False
        """True while written data does not leave this machine."""
        self.loss: float | None = None
        """Share of frames lost over the last seconds, 0 to 1; None: unknown."""
        self.round_trip_s: float | None = None
        """Smoothed round-trip time of the probes; None before the first answer."""
        self.is_proven: bool = False
        """True if the link is known to lead to the vehicle."""
        self.was_proven: bool = False
        """True if :attr:`is_proven` was True before the vehicle rebooted, or before the link was doubted."""
        self.is_doubted: bool = False
        """True if another vehicle with the same system id seems to be behind the link."""
        self.hardware: HardwareId | None = None
        """Hardware id received over the link; None if none was received."""
        self.is_other_hardware: bool = False
        """True if :attr:`hardware` belongs to another vehicle: neither clock nor copies can then prove the link."""
        self._hardware_requests = self._answers_since_request = 0
        self._clock_matches = self._clock_mismatches = self._copies = 0
        self._last_counts = (0, 0)  # frames received and lost

    def record_counts(self, received: int, lost: int, now: float) -> None:
        """Update :attr:`loss` from the total numbers of frames that were received and lost over this link."""
        received_before, lost_before = self._last_counts
        self._last_counts = received, lost
        if received > received_before:
            self.received_at = now
        # Totals shrink when counters are replaced, e.g. those of an evicted peer.
        new_received, new_lost = max(0, received - received_before), max(0, lost - lost_before)
        if new_received or new_lost:
            new_loss = new_lost / (new_received + new_lost)
            weight = 1 - 0.85 ** (new_received + new_lost)  # about the last dozen frames dominate
            self.loss = new_loss if self.loss is None else self.loss + weight * (new_loss - self.loss)

    def record_round_trip(self, seconds: float, now: float) -> None:
        self.answered_at = self.received_at = now
        before = self.round_trip_s
        self.round_trip_s = seconds if before is None else 0.7 * before + 0.3 * seconds

    def record_clock(self, matches: bool, *, may_prove: bool) -> None:
        """Record whether the time in a probe's answer matches the vehicle's clock.

        ``may_prove`` is False while the hardware id, which is stronger evidence, may still be received.
        """
        if matches:
            self._clock_matches, self._clock_mismatches = self._clock_matches + 1, 0
        else:
            self._clock_matches, self._clock_mismatches = 0, self._clock_mismatches + 1
        if self._clock_matches >= MIN_CLOCK_MATCHES and may_prove and not self.is_other_hardware:
            self.is_proven, self.is_doubted = True, False
        elif self._clock_mismatches >= MIN_CLOCK_MATCHES:
            self._doubt()

    def record_copy(self, now: float) -> None:
        self.shared_at = now
        self._copies += 1
        if self._copies >= MIN_COPIES and not self.is_other_hardware:
            self.is_proven, self.is_doubted = True, False

    def reset_proof(self) -> None:
        """Forget all evidence after the vehicle rebooted."""
        self.was_proven = self.was_proven or self.is_proven
        self.is_proven = self.is_other_hardware = False
        self.hardware = None
        self._hardware_requests = self._answers_since_request = 0
        self._clock_matches = self._clock_mismatches = self._copies = 0

    def request_hardware(self) -> bool:
        """Return True if the hardware id is to be requested now, and count the request."""
        if (
            self.hardware is not None
            or self.answered_at == -math.inf
            or self._hardware_requests >= MAX_HARDWARE_REQUESTS
        ):
            return False
        self._hardware_requests += 1
        return True

    @property
    def is_hardware_pending(self) -> bool:
        """True while an answer to a request for the hardware id can still be expected."""
        return self._hardware_requests > 0 and self._answers_since_request < MAX_TIMES_WITHOUT_HARDWARE

    def record_hardware(self, *, is_other: bool) -> None:
        """Record whether the hardware id received over the link contradicts that of the vehicle."""
        if is_other:
            self._doubt()
            self.was_proven = False
        elif self.is_other_hardware:
            self.is_doubted = False
        self.is_other_hardware = is_other

    def record_time(self) -> None:
        """Count a TIMESYNC answer after a request for the hardware id."""
        if self._hardware_requests:
            self._answers_since_request += 1

    def reset_mismatches(self) -> None:
        self._clock_mismatches = 0

    def _doubt(self) -> None:
        self.was_proven = self.was_proven or self.is_proven
        self.is_proven, self.is_doubted = False, True

    def is_alive(self, now: float) -> bool:
        """Return True if frames arrive over the link, and written data leaves."""
        is_answering = now - self.answered_at <= 2 * UNPROBED_TIMEOUT_S
        timeout_s = PROBED_TIMEOUT_S if is_answering and not self.is_costly else UNPROBED_TIMEOUT_S
        return self.is_available and not self.is_stalled and now - self.received_at <= timeout_s

    def failure(self) -> str:
        """Return the reason why the link is no longer used, for events."""
        if self.is_other_hardware:
            return "another vehicle"
        if not self.is_available:
            return "lost"
        return "stalled" if self.is_stalled else "silent"

    @property
    def cost_s(self) -> float:
        """Expected time for a command and its answer, retries after losses included."""
        loss = min(0.9, self.loss or 0.0)
        round_trip_s = 0.1 if self.round_trip_s is None else self.round_trip_s
        # The constant keeps links with round trips of a few milliseconds about equal. The loss counts twice, because
        # the command and its answer must both arrive.
        return (round_trip_s + 0.05) / (1 - loss) ** 2


# Two links that carried the same frame within this time carry one stream.
SHARED_MAX_AGE_S = 5.0

# A working link is replaced only if another link has cost less than this share of the working link's cost for
# MIN_BETTER_S.
MAX_COST_RATIO = 0.5
MIN_BETTER_S = 3.0

JITTER_S = 0.05

# Maximum wait for a moment without a command in transit, because set-points may be sent continuously.
MAX_SWITCH_DELAY_S = 10.0


class LinkChoice:
    """The links to one system, and the link in use.

    Systems with an autopilot need proof (``needs_proof``) that a second link leads to the same vehicle: a matching
    clock, or the same frames. Without proof, the frames of the link are refused, and no command is sent over it. A link
    with a different hardware id is refused even if the clock matches.
    """

    def __init__(self, *, needs_proof: bool) -> None:
        self.needs_proof: bool = needs_proof
        self.candidates: dict[int, Candidate] = {}
        self.clock: VehicleClock = VehicleClock()
        self.hardware: HardwareId | None = None
        """The vehicle's hardware id, as received over the link that was in use then."""
        self._hardware_link = -1  # the link over which `hardware` was received; its next id replaces `hardware`
        self.used: Candidate | None = None
        """The link in use; None before the first choice."""
        self.former: Candidate | None = None
        """The link used before; it may still deliver answers."""
        self.changed_at: float = -math.inf
        self.fresh_after: float = -math.inf
        """Telemetry received before this time is older than the last telemetry of the former link."""
        self._better: Candidate | None = None  # a link that has been better than the link in use since `_better_since`
        self._better_since = 0.0
        self._command_at = -math.inf  # time of the last command to the system

    def record_heartbeat(self, link: int, now: float, *, is_costly: bool) -> Candidate:
        candidate = self.candidates.get(link)
        if candidate is None:
            candidate = self.candidates[link] = Candidate(link, is_costly=is_costly, now=now)
        candidate.received_at = now
        return candidate

    def start_with(self, candidate: Candidate) -> None:
        """Make this link the reference for all other links, because it received the system's first autopilot."""
        self.needs_proof = True
        if candidate is not self.used:
            self.used = None  # the old link leads to another component, e.g. a camera
            self.candidates = {candidate.link: candidate}

    def record_answer(self, link: int, at: float, vehicle_s: float, round_trip_s: float, now: float) -> None:
        """Record the vehicle's time ``vehicle_s``, received over a link; ``at`` is our time at that moment."""
        candidate = self.candidates[link]
        # Compared before this answer is recorded: the link in use has missed an earlier answer, too.
        is_used_silent = self.used is not None and self.used.answered_at < candidate.answered_at
        candidate.record_round_trip(round_trip_s, now)
        if candidate is self.used:
            if not self.clock.add(at, vehicle_s, round_trip_s):
                # The vehicle may have rebooted or been replaced by another one, so the next hardware id over this link
                # is accepted.
                self._hardware_link = link
                for affected in self.candidates.values():
                    affected.reset_proof()
            elif not self.clock.is_steady:
                for affected in self.candidates.values():
                    affected.reset_mismatches()
        else:
            candidate.record_time()
            matches = self.clock.matches(at, vehicle_s, round_trip_s)
            if not matches and is_used_silent:
                # The link in use may be dead, and the vehicle may have paused or rebooted since. Its clock then proves
                # nothing against this link, so without a matching hardware id the answer is not judged (None).
                matches = True if self._is_same_by_hardware(candidate, now) else None
            if matches is not None:
                candidate.record_clock(matches, may_prove=not self._awaits_hardware(candidate))

    def record_hardware(self, link: int, hardware: HardwareId) -> None:
        """Record a hardware id received over a link.

        An id received over the link in use becomes the vehicle's id. If it contradicts an id that was received over
        another link before, the link in use leads to another vehicle.
        """
        candidate = self.candidates[link]
        if hardware.has_value or candidate.hardware is None:
            candidate.hardware = hardware
        if candidate is self.used:
            self._adopt_hardware(candidate)
        for compared in self.candidates.values():
            if self.hardware is not None and compared.hardware is not None:
                compared.record_hardware(is_other=self.hardware.contradicts(compared.hardware))

    def may_be_used(self, candidate: Candidate) -> bool:
        """Return True if frames and commands may use the link: it is in use, is proven, or needs no proof."""
        if candidate.is_other_hardware:
            return False
        return self.used in (None, candidate) or candidate.is_proven or not self.needs_proof

    def is_shared(self, candidate: Candidate, now: float) -> bool:
        """Return True if the link carries the same frames as the link in use."""
        return now - candidate.shared_at <= SHARED_MAX_AGE_S

    def choose(self, now: float) -> str | None:
        """Select the link to use. Return the reason for a change; None without a change."""
        alive = sorted(
            (link for link in self.candidates.values() if self.may_be_used(link) and link.is_alive(now)),
            key=lambda candidate: (candidate.is_costly, candidate.cost_s),
        )
        if not alive:
            return None
        best, used = alive[0], self.used
        if used is None:
            return self._change(best, "first heard", now)
        if used not in alive:
            return self._change(best, used.failure(), now)
        is_better = best.is_costly < used.is_costly or best.cost_s < MAX_COST_RATIO * used.cost_s
        if best is used or not is_better:
            self._better = None
        elif best is not self._better:
            self._better, self._better_since = best, now
        elif now - self._better_since >= MIN_BETTER_S and not self._must_wait(used, now):
            return self._change(best, "cheaper" if best.is_costly < used.is_costly else "better", now)
        return None

    def record_command(self, now: float) -> None:
        self._command_at = now

    def should_request_hardware(self, candidate: Candidate, *, is_attached: bool) -> bool:
        """Return True if the hardware id is to be requested over this link, and count the request.

        Over the link in use, an attached vehicle object (``is_attached``) requests the id itself.
        """
        if candidate is not self.used:
            return not candidate.is_proven and candidate.request_hardware()
        return len(self.candidates) > 1 and not is_attached and candidate.request_hardware()

    def _is_same_by_hardware(self, candidate: Candidate, now: float) -> bool:
        """Return True if a matching hardware id suffices: the link was proven before, and no other link is alive."""
        is_same = (
            self.hardware is not None and candidate.hardware is not None and self.hardware.confirms(candidate.hardware)
        )
        alive = [link for link in self.candidates.values() if link.is_alive(now)]
        return candidate.was_proven and is_same and alive == [candidate]

    def _awaits_hardware(self, candidate: Candidate) -> bool:
        can_compare_ids = self.hardware is not None and candidate.hardware is not None
        return candidate.is_hardware_pending and not can_compare_ids

    def _adopt_hardware(self, used: Candidate) -> None:
        """Make the id received over the link in use the vehicle's id, unless another link's id contradicts it."""
        hardware = used.hardware
        if hardware is None or not hardware.has_value:
            return
        is_from_same_link = self._hardware_link == used.link
        if self.hardware is None or is_from_same_link or not self.hardware.contradicts(hardware):
            self.hardware, self._hardware_link = hardware, used.link

    def _must_wait(self, used: Candidate, now: float) -> bool:
        """Return True while a command in transit could arrive after a later command over the better link."""
        transit_s = (used.round_trip_s or 0.0) + JITTER_S
        waited_s = now - self._better_since - MIN_BETTER_S
        return now - self._command_at <= transit_s and waited_s <= MAX_SWITCH_DELAY_S

    def _change(self, chosen: Candidate, reason: str, now: float) -> str:
        """Use this link from now on. Return the reason."""
        former = self.used
        if former is not None:
            extra_transit_s = ((chosen.round_trip_s or 0.0) - (former.round_trip_s or 0.0)) / 2
            self.fresh_after = former.received_at + extra_transit_s + JITTER_S
            # The former and the new link lead to the same vehicle; otherwise the new link would not be used.
            former.is_proven = not former.is_other_hardware
        self.former, self.used, self.changed_at, self._better = former, chosen, now, None
        self._adopt_hardware(chosen)
        return reason
