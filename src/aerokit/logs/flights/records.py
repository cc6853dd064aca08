"""The records of a log in order, as input for converters, each with the values of the states that it updates."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

from aerokit._internal.values import Snapshot
from aerokit.autopilots import autopilot_for
from aerokit.connection.heartbeats import is_autopilot
from aerokit.errors import FileFormatError
from aerokit.mavlink.dialect import STANDARD
from aerokit.mavlink.framer import Framer
from aerokit.mavlink.messages import AutopilotVersion, Heartbeat, ParamSet, ParamValue, Statustext
from aerokit.mavlink.tlog import read_tlog
from aerokit.parameters.encoding import value_of
from aerokit.vehicle.state.states import SOURCES
from aerokit.vehicle.state.telemetry import Telemetry

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping
    from pathlib import Path

    from aerokit.autopilots import Autopilot
    from aerokit.mavlink.message import Message

# A record with a MAVLink message has no `fields`, because its values are in `message`.
_NO_FIELDS: Mapping[str, Any] = {}
_PARAMETER_IDS = frozenset((Heartbeat.ID, AutopilotVersion.ID, ParamSet.ID, ParamValue.ID))

_COLUMN_KINDS = {"float": "float", "double": "float", "uint64_t": "uint"}
_UNITS = {"%": "percent", "c%": "centipercent", "d%": "decipercent", "m/s/s": "m_s2", "m/s^2": "m_s2"}


class TableColumn(Snapshot):
    """A column of a table: its name with the unit, its field, and its ``kind``.

    A kind is float, int, uint, str, bool or time.
    """

    name: str
    field: str
    kind: str


class LogRecord(NamedTuple):
    """One record of a log: a MAVLink message, or a row of a flight controller's own log.

    It is a tuple, because a log has millions of records, and a `Snapshot` takes twice as long to create.
    """

    unix_s: float
    """Time of the record: UTC in seconds since 1970."""
    system_id: int
    component_id: int
    table: str
    """Record type: ``GPS_RAW_INT`` in a ``.tlog``, ``GPS`` in a ``.bin``, ``vehicle_gps_position`` in a ``.ulg``."""
    fields: Mapping[str, Any]
    states: tuple[tuple[str, Any], ...]
    """Names and values of the states that the record changes, as in docs/states.md."""
    message: Message | None = None


class LogReader:
    """Reads one log. Call `entries` only once. ``notes`` lists the problems found so far."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.needs_states: bool = True
        """Set it to False to omit the states of a ``.tlog``'s records, because decoding them takes most of the time."""
        self.notes: list[str] = []

    def entries(self, on_bytes: Callable[[int], object]) -> Iterator[LogRecord]:
        """Yield all records in order. ``on_bytes`` is called from time to time with the number of bytes read so far."""
        raise NotImplementedError

    def columns(self, entry: LogRecord) -> list[TableColumn]:
        """Return the columns of the table to which a record belongs."""
        raise NotImplementedError


def name_with_unit(name: str, unit: str) -> str:
    """Append the unit to a name that does not end with it: ``alt`` in mm becomes ``alt_mm``."""
    suffix = _UNITS.get(unit, unit).replace("/", "_").replace("*", "").replace("^", "")
    suffix = "".join(character for character in suffix if character.isalnum() or character == "_")
    has_suffix = name.lower().endswith(f"_{suffix.lower()}")
    return f"{name}_{suffix}" if suffix and not has_suffix else name


class TlogReader(LogReader):
    """Reads a ``.tlog`` of a ground station."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._vehicles: dict[int, _VehicleStates] = {}
        self._framer = Framer()
        # The encoding of parameters depends on the autopilot and its capabilities.
        self._autopilots: dict[int, tuple[int, Autopilot]] = {}  # system id → component id and autopilot
        self._capabilities: dict[tuple[int, int], int] = {}  # (system id, component id) → capabilities

    def entries(self, on_bytes: Callable[[int], object]) -> Iterator[LogRecord]:
        framer, decode = self._framer, STANDARD.decode
        count = 0
        states: tuple[tuple[str, Any], ...] = ()
        with self.path.open("rb") as file:
            for unix_s, raw in read_tlog(file):
                count += 1
                if count % 4096 == 0:
                    on_bytes(file.tell())  # reports the progress
                for frame in framer.receive(raw, unix_s):
                    message = decode(frame)
                    system_id, component_id = frame.system_id, frame.component_id
                    if frame.message_id in _PARAMETER_IDS:
                        message = self._decode_parameter(message, system_id, component_id)
                    if self.needs_states:
                        states = self._states(system_id, component_id, unix_s, message)
                    yield LogRecord(unix_s, system_id, component_id, message.NAME, _NO_FIELDS, states, message)
                framer.reset()  # the rest of a damaged message must not delay the next one
            on_bytes(file.tell())
        self._check_statistics(count)

    def _decode_parameter(self, message: Message, system_id: int, component_id: int) -> Message:
        """Decode the ``param_value`` of an autopilot's parameter. Return other messages unchanged."""
        # HEARTBEAT and AUTOPILOT_VERSION show how a vehicle encodes integer parameters. PX4 sends their bits as a
        # float.
        if isinstance(message, Heartbeat):
            if system_id not in self._autopilots and is_autopilot(message):
                self._autopilots[system_id] = component_id, autopilot_for(message)
        elif isinstance(message, AutopilotVersion):
            self._capabilities[system_id, component_id] = message.capabilities
        elif isinstance(message, ParamValue):
            return self._with_decoded_value(message, system_id, component_id)
        elif isinstance(message, ParamSet):
            return self._with_decoded_value(message, message.target_system, message.target_component)
        return message

    def _with_decoded_value(self, message: ParamValue | ParamSet, system_id: int, component_id: int) -> Message:
        autopilot_id, autopilot = self._autopilots.get(system_id, (0, None))
        # Other components' values stay as they were sent, because their encoding is unknown.
        if autopilot is None or component_id not in (0, autopilot_id):  # 0 means all components
            return message
        capabilities = self._capabilities.get((system_id, autopilot_id))
        value = value_of(message, autopilot.encodes_parameters_bytewise(capabilities))
        return type(message)(**{**message.to_dict(), "param_value": float(value)})

    def columns(self, entry: LogRecord) -> list[TableColumn]:
        assert entry.message is not None
        columns = []
        for field in entry.message.FIELDS:
            name = name_with_unit(field.name, field.units)
            kind = _COLUMN_KINDS.get(field.type, "int")
            if field.is_text or (field.array_length and field.type in ("uint8_t", "char")):
                columns.append(TableColumn(name, field.name, "str"))
            elif field.array_length:
                indices = range(field.array_length)
                columns += [TableColumn(f"{name}_{index}", f"{field.name}.{index}", kind) for index in indices]
            else:
                columns.append(TableColumn(name, field.name, kind))
        return columns

    def _states(
        self, system_id: int, component_id: int, unix_s: float, message: Message
    ) -> tuple[tuple[str, Any], ...]:
        vehicle = self._vehicles.get(system_id)
        # A vehicle has states from the first HEARTBEAT of its autopilot on.
        if vehicle is None:
            if not isinstance(message, Heartbeat) or not is_autopilot(message):
                return ()
            vehicle = _VehicleStates(system_id, component_id)
            self._vehicles[system_id] = vehicle
        return vehicle.update(unix_s, message) if vehicle.component_id == component_id else ()

    def _check_statistics(self, records: int) -> None:
        if not records:
            raise FileFormatError(f"{self.path} contains no MAVLink messages: it is not a .tlog, or it is empty")
        statistics = self._framer.statistics
        if not statistics.frames:
            raise FileFormatError(f"{self.path} contains no MAVLink message with a valid checksum")
        if statistics.bad_crcs:
            self.notes.append(f"{statistics.bad_crcs} of {records} messages are damaged and were skipped")
        if statistics.unknown_ids:
            self.notes.append(f"{statistics.unknown_ids} messages of an unknown dialect were skipped")


class _VehicleStates:
    """Decodes the states of one vehicle with `Telemetry`, like a live vehicle."""

    def __init__(self, system_id: int, component_id: int) -> None:
        self.component_id = component_id
        self._now = 0.0
        self._telemetry = Telemetry(lambda: self._now, system_id=system_id, component_id=component_id)
        # Maps the name of a message class to the names of the states that are decoded from it, except "status_text".
        self._states_by_message: dict[str, tuple[str, ...]] = {
            name: tuple(field.name for field, _ in rows) for name, rows in SOURCES.items() if name != "Statustext"
        }
        self._expired_at = 0.0

    def update(self, unix_s: float, message: Message) -> tuple[tuple[str, Any], ...]:
        """Return the names and values of the states that a message changes."""
        now = max(unix_s, self._now + 1e-6)  # always increases, although the clock may have been set back
        self._now = now
        telemetry = self._telemetry
        may_have_texts = isinstance(message, Statustext)
        names = self._states_by_message.get(type(message).__name__, ())
        if names or may_have_texts:
            if message.received_frame is not None:
                message.received_frame.received_at = now  # Telemetry gives this time to the states.
            telemetry.receive(message)
        if now - self._expired_at > 1.0:
            telemetry.expire(now)  # publishes status texts whose last parts are missing
            self._expired_at = now
            may_have_texts = True
        cells = telemetry.cells
        states = tuple((name, cells[name].latest) for name in names if cells[name].updated_at == now)
        if may_have_texts:  # A STATUSTEXT can publish two texts: its own, and an earlier one whose rest is missing.
            states += tuple(("status_text", text) for text in telemetry.texts_since(now))
        return states
