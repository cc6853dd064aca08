"""A DroneKit program connected to a scripted flight controller; scenarios return their observations as plain data.

The stage is independent of the DroneKit implementation that it runs.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import logging
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

from flight_controller import FlightController, Received

__all__ = [
    "SCENARIOS",
    "TEST_TIMEOUT_S",
    "Scenario",
    "Stage",
    "as_json",
    "caught",
    "on_stage",
    "plain",
    "play",
    "scenario",
    "until",
]

TEST_TIMEOUT_S = 100.0
ALWAYS = ("PING", "HEARTBEAT", "REQUEST_DATA_STREAM", "PARAM_REQUEST_READ")
"""Messages that are sent continuously, independent of the program."""
QUIET = 3
"""Round trips without new messages after which an action counts as finished."""


class Stage:
    """A connected vehicle and its flight controller."""

    def __init__(self, dronekit: Any, controller: FlightController, vehicle: Any) -> None:
        self.dronekit, self.fc, self.vehicle = dronekit, controller, vehicle
        self._numbers = itertools.count(1)
        self._seen: set[int] = set()
        self._saw = threading.Condition()
        vehicle.add_message_listener("DEBUG", self._on_debug)

    def settle(self) -> None:
        """Wait until all messages of the flight controller are processed and all listeners have run."""
        number = next(self._numbers)
        with self._saw:
            for _ in range(int(TEST_TIMEOUT_S / 0.1)):  # datagrams get lost
                self.fc.report("DEBUG", ind=7, time_boot_ms=number)
                if self._saw.wait_for(lambda: number in self._seen, 0.1):
                    return
        raise AssertionError("the vehicle's listeners received nothing")

    def reached(self) -> None:
        """Wait until the flight controller has received all messages of the program, and their effects have arrived.

        An answer may release another message: the second of two equal commands waits for the first one's answer.
        """
        count, quiet = -1, 0
        while quiet < QUIET:
            self._round_trip()
            before, count = count, len([frame for frame in self.fc.received() if frame.name not in ALWAYS])
            quiet = quiet + 1 if count == before else 0

    def _round_trip(self) -> None:
        self.settle()
        number = next(self._numbers)
        self.vehicle.send_mavlink(self.vehicle.message_factory.ping_encode(0, number, 0, 0))
        self.fc.wait_for("PING", lambda frame: frame.seq == number)

    def report(self, name: str, **fields: Any) -> None:
        """Have the flight controller send a message, and wait until the program has processed it."""
        self.fc.report(name, **fields)
        self.settle()

    def beat(self, **fields: Any) -> None:
        """Have the flight controller send a heartbeat, and wait until the program has processed it."""
        self.fc.beat(**fields)
        self.settle()

    def sent_by(self, action: Callable[[], object], *names: str) -> list[Received]:
        """Return the messages that an action sends: these types; without names, commands that change something."""
        since = self.fc.mark()
        action()
        self.reached()
        return self.fc.received(*names, since=since) if names else self.fc.commands(since=since)

    def commands_of(self, action: Callable[[], object]) -> list[tuple[float, ...]]:
        """Return the commands that the program sent during an action: number, then param1 to param7."""
        return [(frame.command, *(round(p, 5) for p in frame.params)) for frame in self.sent_by(action)]

    def assign(self, name: str, value: Any) -> Callable[[], None]:
        """``vehicle.name = value``, as an action."""
        return lambda: setattr(self.vehicle, name, value)

    def listen(
        self, *names: str, to: Any = None, into: list[tuple[str, str, str]] | None = None
    ) -> list[tuple[str, str, str]]:
        """Listen to attributes: ``(class of the object, name, value)`` of each notification, in order."""
        events: list[tuple[str, str, str]] = [] if into is None else into

        def listener(source: Any, name: str, value: Any) -> None:
            if name != "last_heartbeat":
                events.append((type(source).__name__, name, plain(value)))

        for name in names:
            (self.vehicle if to is None else to).add_attribute_listener(name, listener)
        return events

    @contextlib.contextmanager
    def logged(self, name: str = "dronekit", *, having: str = "") -> Iterator[list[str]]:
        """Collect log records as ``LEVEL text``; the filter excludes other vehicles, which share the logger."""
        lines: list[str] = []
        handler = logging.Handler()

        def emit(record: logging.LogRecord) -> None:
            if having in (text := record.getMessage()):
                lines.append(f"{record.levelname} {text}")

        handler.emit = emit  # type: ignore[method-assign]
        logger = logging.getLogger(name)
        level = logger.level
        logger.addHandler(handler)
        logger.setLevel(logging.DEBUG)
        try:
            yield lines
        finally:
            logger.removeHandler(handler)
            logger.setLevel(level)

    def _on_debug(self, _vehicle: Any, _name: str, message: Any) -> None:
        with self._saw:
            self._seen.add(message.time_boot_ms)
            self._saw.notify_all()


@dataclass(frozen=True)
class Scenario:
    """One row of the behaviour table, or a part of it."""

    name: str
    play: Callable[[Stage], Any]
    expected: Any
    controller: dict[str, Any] = field(default_factory=dict)
    connect: dict[str, Any] = field(default_factory=dict)
    is_slow: bool = False
    is_kept: bool = True
    prepare: Callable[[FlightController], object] = lambda _: None


SCENARIOS: list[Scenario] = []


def scenario(expected: Any, **options: Any) -> Callable[[Callable[[Stage], Any]], Callable[[Stage], Any]]:
    """Decorator: make a scenario of a function that takes a stage and returns its observations.

    Args:
        expected: the observations that the scenario must return.
        options: ``controller`` and ``connect``, arguments of both; ``is_slow``: the scenario waits for timeouts;
            ``is_kept``: DroneKit behaves the same; ``prepare``: called with the flight controller before connecting.
    """

    def register(function: Callable[[Stage], Any]) -> Callable[[Stage], Any]:
        SCENARIOS.append(Scenario(function.__name__, function, expected, **options))
        return function

    return register


@contextlib.contextmanager
def on_stage(
    dronekit: Any,
    controller: dict[str, Any] | None = None,
    connect: dict[str, Any] | None = None,
    prepare: Callable[[FlightController], object] = lambda _: None,
) -> Iterator[Stage]:
    """Start a flight controller, connect to it, and close both in the end.

    Streams are requested only if ``connect`` contains a rate: connecting waits for streams, and here there are none.
    """
    with FlightController(**(controller or {})) as fc:
        prepare(fc)
        vehicle = dronekit.connect(fc.address, **{"rate": None, **(connect or {})})
        try:
            yield Stage(dronekit, fc, vehicle)
        finally:
            vehicle.close()


def play(dronekit: Any, case: Scenario, **controller: Any) -> Any:
    """Return the observations of a scenario with this implementation."""
    options = {**case.controller, **controller}
    with on_stage(dronekit, options, case.connect, case.prepare) as stage:
        return case.play(stage)


def caught(action: Callable[[], object]) -> str:
    """Return class and text of the exception of an action, or its result."""
    try:
        return plain(action())
    except Exception as error:
        return f"{type(error).__name__}: {error}"


def plain(value: Any) -> str:
    """A value as text."""
    return "Locations" if type(value).__name__ == "Locations" else str(value)


def until(condition: Callable[[], object]) -> None:
    """Poll until a condition holds that has no event."""
    deadline = time.monotonic() + 100
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def as_json(value: Any) -> Any:
    """Normalise for comparison: tuples equal lists, 1 equals 1.0."""
    return json.loads(json.dumps(value))
