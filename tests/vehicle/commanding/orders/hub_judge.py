"""Rules that a hub must never break: compares what it passed to the vehicle with what the program sent."""

from __future__ import annotations

from collections.abc import Iterator

from order_air import TrafficEntry
from order_flights import Flown
from order_hub import HubSky

from aerokit.hub.message_rules import ORDER_MAX_AGE_S, MessageKind, kind_of
from aerokit.hub.switch import MAX_POLL_INTERVAL_S
from aerokit.vehicle.commanding.order import QUESTIONS

ARM_WATCH_S = ORDER_MAX_AGE_S + MAX_POLL_INTERVAL_S + 0.001
ROUNDING_S = 1e-6


def hub_faults(flown: Flown) -> list[str]:
    """Every order that the hub has made up, doubled, kept too long or sent in another order; in words."""
    sky = flown.air
    assert isinstance(sky, HubSky)
    return list(_passed_on(sky))


def orders_in(crossings: list[TrafficEntry]) -> list[TrafficEntry]:
    """Those that change what a vehicle does or keeps."""
    return [
        crossing
        for crossing in crossings
        if kind_of(crossing.message.NAME, is_for_one=True) is MessageKind.ORDER
        and getattr(crossing.message, "command", None) not in QUESTIONS
    ]


def _passed_on(sky: HubSky) -> Iterator[str]:
    written: dict[bytes, list[TrafficEntry]] = {}
    for order in orders_in(sky.sent):
        written.setdefault(order.raw, []).append(order)
    newest = -1
    for each in orders_in(sky.at_vehicle.sent):
        what = f"{each.message.NAME} at {each.at:.2f}"
        if each.raw not in written:
            yield f"{what} is nobody's"
            continue
        before = [one for one in written[each.raw] if one.arrives_at <= each.at + ROUNDING_S]
        if not before:
            yield f"{what} was passed on once more"
            continue
        written[each.raw].remove(before[0])
        if each.at - before[0].arrives_at > ARM_WATCH_S:
            yield f"{what} was kept for {each.at - before[0].arrives_at:.2f} s"
        if before[0].number < newest:
            yield f"{what} was passed on after a newer one"
        newest = max(newest, before[0].number)
