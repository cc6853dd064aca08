"""Rules that a hub must never break: compares the orders it forwarded with the orders the program sent."""

from __future__ import annotations

from collections.abc import Iterator

from disturbed_hub import DisturbedHubPath
from disturbed_link import TrafficEntry
from order_flights import Flown

from aerokit.hub.message_rules import ORDER_MAX_AGE_S, MessageKind, kind_of
from aerokit.hub.switch import MAX_POLL_INTERVAL_S
from aerokit.vehicle.commanding.order import REQUEST_COMMANDS

ARM_WATCH_S = ORDER_MAX_AGE_S + MAX_POLL_INTERVAL_S + 0.001
ROUNDING_S = 1e-6
VEHICLE_IDS = bytes((1, 1))
"""System and component id of the vehicle, as in the header of a frame."""


def hub_faults(flown: Flown) -> list[str]:
    """Return a description of each order that the hub invented, duplicated, kept too long or reordered."""
    path = flown.traffic
    assert isinstance(path, DisturbedHubPath)
    return list(_passed_on(path))


def orders_in(crossings: list[TrafficEntry]) -> list[TrafficEntry]:
    """Return the messages that change the vehicle's behaviour or stored data."""
    return [
        crossing
        for crossing in crossings
        if kind_of(crossing.message.NAME, has_target=True) is MessageKind.ORDER
        and getattr(crossing.message, "command", None) not in REQUEST_COMMANDS
    ]


def _passed_on(path: DisturbedHubPath) -> Iterator[str]:
    written: dict[bytes, list[TrafficEntry]] = {}
    for order in orders_in(path.sent):
        written.setdefault(order.raw, []).append(order)
    newest = -1
    for passed in orders_in(path.at_vehicle.sent):
        what = f"{passed.message.NAME} at {passed.at:.2f}"
        if passed.raw[5:7] == VEHICLE_IDS:
            continue  # The splitter passes the vehicle's own frames to both endpoints. The vehicle ignores them.
        if passed.raw not in written:
            yield f"{what} was not sent by the program"
            continue
        before = [order for order in written[passed.raw] if order.arrives_at <= passed.at + ROUNDING_S]
        if not before:
            yield f"{what} was passed on twice"
            continue
        written[passed.raw].remove(before[0])
        if passed.at - before[0].arrives_at > ARM_WATCH_S:
            yield f"{what} was kept for {passed.at - before[0].arrives_at:.2f} s"
        if before[0].number < newest:
            yield f"{what} was passed on after a newer one"
        newest = max(newest, before[0].number)
