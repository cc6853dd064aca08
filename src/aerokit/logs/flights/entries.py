"""What a converter is given: the entries of a log one after the other, each with the states that it changed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from aerokit._internal.values import Snapshot
from aerokit.connection.components import is_autopilot
from aerokit.errors import FileFormatError
from aerokit.mavlink.dialect import STANDARD
from aerokit.mavlink.framer import Framer
from aerokit.mavlink.messages import Heartbeat
from aerokit.mavlink.tlog import read_tlog
from aerokit.vehicle.state.states import SOURCES
from aerokit.vehicle.state.telemetry import Telemetry

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping
    from pathlib import Path

    from aerokit.mavlink.message import Message

_EARLIEST_S = 946_684_800.0
"""The year 2000: what claims to be earlier was written by a clock that was never set."""
_KINDS = {"float": "float", "double": "float", "uint64_t": "uint"}
_UNITS = {"%": "percent", "c%": "centipercent", "d%": "decipercent", "m/s/s": "m_s2", "m/s^2": "m_s2"}


class Column(Snapshot):
    """A column of a table: a name that holds the unit, the field it is made of, and ``kind``: float, int, uint, str."""

    name: str
    field: str
    kind: str


class Entry(Snapshot):
    """One entry of a log: a MAVLink message, or a row of one of the tables of a flight controller's own log."""

    unix_s: float
    """Seconds since 1970, UTC."""
    system_id: int
    component_id: int
    table: str
    """``GPS_RAW_INT`` in a ``.tlog``, ``GPS`` in a ``.bin``, ``vehicle_gps_position`` in a ``.ulg``."""
    fields: Mapping[str, Any]
    states: tuple[tuple[str, Any], ...]
    """Names and values of the states that it changed, as docs/states.md has them."""
    message: Message | None = None


class Log:
    """A log that can be read once; ``notes`` says what was wrong with it, as far as it was read."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.notes: list[str] = []

    def entries(self, on_bytes: Callable[[int], object]) -> Iterator[Entry]:
        """All entries in their order; ``on_bytes(read)`` is called now and then."""
        raise NotImplementedError

    def columns(self, entry: Entry) -> list[Column]:
        """The columns of the table that an entry belongs to."""
        raise NotImplementedError


def unit_suffix(name: str, unit: str) -> str:
    """``name`` with the unit behind it, unless it is there already: ``alt`` in mm is ``alt_mm``."""
    suffix = _UNITS.get(unit, unit).replace("/", "_").replace("*", "").replace("^", "")
    suffix = "".join(each for each in suffix if each.isalnum() or each == "_")
    return name if not suffix or name.lower().endswith(f"_{suffix.lower()}") else f"{name}_{suffix}"


class TlogFile(Log):
    """A ``.tlog``: what a ground station heard and sent."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._vehicles: dict[int, _Vehicle] = {}
        self._framer = Framer()

    def entries(self, on_bytes: Callable[[int], object]) -> Iterator[Entry]:
        """All messages that the standard knows and whose checksums are right."""
        framer, decode, count = self._framer, STANDARD.decode, 0
        with self.path.open("rb") as file:
            for unix_s, raw in read_tlog(file):
                count += 1
                if not count & 0xFFF:
                    on_bytes(file.tell())
                for frame in framer.receive(raw, unix_s):
                    message = decode(frame)
                    states = self._states(frame.system_id, frame.component_id, unix_s, message)
                    yield Entry(
                        unix_s, frame.system_id, frame.component_id, message.NAME, {}, states, message
                    )
            on_bytes(file.tell())
        self._note(count)

    def columns(self, entry: Entry) -> list[Column]:
        """The fields in the standard's order and units; arrays have a column for each element."""
        assert entry.message is not None
        found = []
        for field in entry.message.FIELDS:
            name = unit_suffix(field.name, field.units)
            kind = _KINDS.get(field.type, "int")
            if field.is_text or (field.array_length and field.type in ("uint8_t", "char")):
                found.append(Column(name, field.name, "str"))
            elif field.array_length:
                indices = range(field.array_length)
                found += [Column(f"{name}_{i}", f"{field.name}.{i}", kind) for i in indices]
            else:
                found.append(Column(name, field.name, kind))
        return found

    def _states(
        self, system_id: int, component_id: int, unix_s: float, message: Message
    ) -> tuple[tuple[str, Any], ...]:
        vehicle = self._vehicles.get(system_id)
        if vehicle is None:
            if not isinstance(message, Heartbeat) or not is_autopilot(message):
                return ()
            vehicle = self._vehicles[system_id] = _Vehicle(system_id, component_id)
        return vehicle.take(unix_s, message) if vehicle.component_id == component_id else ()

    def _note(self, records: int) -> None:
        if not records:
            raise FileFormatError(f"{self.path} holds no MAVLink messages: it is no .tlog, or it is empty")
        counted = self._framer.statistics
        if not counted.frames:
            raise FileFormatError(f"{self.path} holds no MAVLink message with a right checksum")
        if counted.bad_crcs:
            self.notes.append(f"{counted.bad_crcs} of {records} messages are damaged and were left out")
        if counted.unknown_ids:
            self.notes.append(f"{counted.unknown_ids} messages are of an unknown dialect and were left out")


class _Vehicle:
    """The states of one vehicle in a log, by the decoders that live vehicles have."""

    def __init__(self, system_id: int, component_id: int) -> None:
        self.component_id = component_id
        self._now = 0.0
        self._telemetry = Telemetry(lambda: self._now, system_id=system_id, component_id=component_id)
        self._names: dict[str, tuple[str, ...]] = {
            name: tuple(told.name for told, _ in rows) for name, rows in SOURCES.items()
        }
        self._expired_at = 0.0

    def take(self, unix_s: float, message: Message) -> tuple[tuple[str, Any], ...]:
        self._now = now = max(unix_s, self._now + 1e-6)  # a clock that was set back makes nothing younger
        telemetry = self._telemetry
        names = self._names.get(type(message).__name__, ())
        if names:
            if message.received_frame is not None:
                message.received_frame.received_at = now
            telemetry.receive(message)
        if now - self._expired_at > 1.0:
            telemetry.expire(now)
            self._expired_at, names = now, (*names, "status_text")
        cells = telemetry.cells
        return tuple((name, cells[name].latest) for name in names if cells[name].updated_at == now)
