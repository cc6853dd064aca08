"""Makes sentences about silences of the vehicle, and about its configured reaction to a lost ground station."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from aerokit.autopilots.failsafes import GCS_FAILSAFE_ACTIONS, gcs_failsafe
from aerokit.logs.report.formatting import clock_text, duration_text

if TYPE_CHECKING:
    from aerokit.logs.flights.flight import FlightLog, Silence

_MAX_LISTED = 3
# After a silence, it takes at most this long until a HEARTBEAT reports the mode.
_MODE_DELAY_S = 1.5

# Maps firmwares to the parameters of their ground station failsafe that do not select the action.
_OTHER_PARAMETERS: dict[str, tuple[str, ...]] = {
    "PX4": ("COM_DL_LOSS_T",),
    "ArduCopter": ("FS_GCS_TIMEOUT", "FS_OPTIONS"),
    "ArduPlane": ("FS_LONG_TIMEOUT",),
    "Rover": ("FS_GCS_TIMEOUT",),
    "ArduSub": ("FS_GCS_TIMEOUT",),
}


def silence_sentences(flight: FlightLog) -> list[str]:
    silences = [
        silence for silence in flight.silences if any(begin <= silence.begins_s <= end for begin, end in flight.armed)
    ]
    # Messages of other senders were recorded during these silences, so only the vehicle was silent.
    recorded = [silence for silence in silences if silence.is_recorded]
    sentences = [_sentence(flight, silence) for silence in recorded[:_MAX_LISTED]]
    more = len(recorded) - _MAX_LISTED
    if more > 0:
        sentences.append(f"The log has {more} more silence{'' if more == 1 else 's'} of the vehicle.")
    if recorded:
        sentences.append(ground_station_failsafe(flight, recorded[0].begins_s))
    return sentences + _pauses([silence for silence in silences if not silence.is_recorded])


def _pauses(pauses: list[Silence]) -> list[str]:
    if not pauses:
        return []
    longest = max(pauses, key=lambda pause: pause.ends_s - pause.begins_s)
    others = len(pauses) - 1
    more = f", and in {others} shorter gap{'' if others == 1 else 's'}" if others else ""
    return [
        f"The log contains no message of the vehicle for {duration_text(longest.ends_s - longest.begins_s)} from"
        f" {clock_text(longest.begins_s)} on{more}: the vehicle was silent, the recording paused,"
        " or its clock was set forward."
    ]


def _sentence(flight: FlightLog, silence: Silence) -> str:
    is_at_end = silence.ends_s >= flight.duration_s
    state_before = _state(flight, silence.begins_s)
    text = f"Nothing was received from the vehicle for {duration_text(silence.ends_s - silence.begins_s)}"
    text += f" from {clock_text(silence.begins_s)} on"
    if is_at_end:
        text += ", until the log ends"
    text += f"; it was last {state_before}." if state_before else "."
    state_after = "" if is_at_end else _state(flight, silence.ends_s + _MODE_DELAY_S)
    return f"{text} Afterwards it was {state_after}." if state_after else text


def _state(flight: FlightLog, time_s: float) -> str:
    """Return height and mode, such as "12.5 m above home in LOITER"; empty if both are unknown."""
    height_m = flight.track.at("altitude_relative_m", time_s)
    mode = flight.mode_at(time_s)
    parts = []
    if not math.isnan(height_m):
        parts.append(f"{height_m:.1f} m above home")
    if mode:
        parts.append(f"in {mode}")
    return " ".join(parts)


def ground_station_failsafe(flight: FlightLog, time_s: float) -> str:
    """Return a sentence about the vehicle's configured reaction to a lost ground station."""
    firmware = next((name for name in GCS_FAILSAFE_ACTIONS if name in flight.vehicle), "")
    if not firmware:
        return "How the vehicle reacts to a lost ground station is unknown."
    names = (*GCS_FAILSAFE_ACTIONS[firmware], *_OTHER_PARAMETERS[firmware])
    values = {name: value for name in names if not math.isnan(value := flight.parameter_at(name, time_s))}
    deciding_name = names[0]  # Without its value, the others do not tell whether the vehicle reacts.
    if deciding_name not in values:
        return (
            "How the vehicle reacts to a lost ground station is unknown, because the log does not contain"
            f" {deciding_name}; look at {', '.join(names)}."
        )
    decisive_name, action = gcs_failsafe(firmware, values.get)
    texts = {name: f"{name} = {value:g}" for name, value in values.items()}
    if decisive_name is not None and action is not None:
        texts[decisive_name] += f" ({action})"
    return f"If the vehicle also lost the ground station, it reacts as configured: {', '.join(texts.values())}."
