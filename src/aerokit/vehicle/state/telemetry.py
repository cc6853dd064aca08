"""`Telemetry`: the state cells of one vehicle, and how messages update them."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from aerokit.autopilots import Autopilot, autopilot_for
from aerokit.connection.cells import Source, StateCell
from aerokit.connection.heartbeats import is_autopilot
from aerokit.mavlink.enums import MavLandedState, MavState
from aerokit.mavlink.message import decoder_of, offset_of
from aerokit.vehicle.state.field import MESSAGE_IDS, Context, MessageSource, StreamedMessage, message_type
from aerokit.vehicle.state.states import DEFAULT_RATES_HZ, LAZY, SOURCES, STATES, States
from aerokit.vehicle.state.status_text import StatusTextAssembler

if TYPE_CHECKING:
    from collections.abc import Iterable

    from aerokit.autopilots.modes import Mode
    from aerokit.mavlink import messages
    from aerokit.mavlink.frame import Frame
    from aerokit.mavlink.message import Message
    from aerokit.vehicle.state.condition import StatusText
    from aerokit.vehicle.state.field import StateField

# A fallback message is ignored for this many seconds after a better message has reported the state.
FALLBACK_DELAY_S = 2.0
# Maximum number of mode names to store. A faulty vehicle could send AVAILABLE_MODES with ever new modes.
MAX_MODE_NAMES = 256
LANDED_STATE_MAX_AGE_S = 5.0
"""Maximum age in seconds of a landed state that counts as the present one. Vehicles send it at 1 Hz or faster."""

Handler = Callable[[Any, Source], None]


class Telemetry(States):
    """All state cells of one vehicle, updated by its messages.

    It processes the messages of the autopilot (``system_id``, ``component_id``), and messages that your program has
    built, which have no frame. ``clock`` returns seconds. If ``autopilot`` is None, the first HEARTBEAT determines it.
    """

    autopilot: Autopilot

    def __init__(
        self,
        clock: Callable[[], float],
        *,
        system_id: int = 1,
        component_id: int = 1,
        autopilot: Autopilot | None = None,
    ) -> None:
        self.system_id: int = system_id
        self.component_id: int = component_id
        self.autopilot = autopilot or Autopilot(0)
        self._knows_autopilot = autopilot is not None
        self._clock = clock
        self._lock = threading.RLock()  # Any thread may read a cell, and reading decodes pending frames.
        # Arrival time of the frame that is being processed; None if there is none.
        self._arrived_at: float | None = None
        self._texts = StatusTextAssembler()
        self.has_available_modes: bool = False
        """True once AVAILABLE_MODES was received."""
        # Maps custom_mode to the name in AVAILABLE_MODES.
        self._mode_names: dict[int, str] = {}
        self._context = Context(self.autopilot, self._mode_names, lambda: self.home.is_known)
        self._cells: dict[str, StateCell[Any]] = {
            name: StateCell(name, clock, field.waits_for(self.autopilot), stamp=self._time_of_arrival)
            for name, field in STATES.items()
        }
        # `_handlers` get decoded messages. `_streams` keep frames, and decode them when a value is read.
        handlers = {name: self._handler(name) for name in (*SOURCES, "AvailableModes")}
        self._handlers = {MESSAGE_IDS[name]: self._receiver(name, handler) for name, handler in handlers.items()}
        self._streams = {MESSAGE_IDS[name]: self._streamed_message(name, handlers[name]) for name in LAZY}
        # When a program reads a cell, the streams of the cell first decode the frames that they have kept.
        for cell_name, cell in self._cells.items():
            lazy_messages = (source.message for source in STATES[cell_name].sources if source.message in LAZY)
            cell._feed_from(*(self._streams[MESSAGE_IDS[name]] for name in lazy_messages))

    # ----------------------------------------------------------------------------- receiving

    @property
    def handles(self) -> Mapping[int, Callable[[Any], None]]:
        """Message handlers by message id."""
        return self._handlers

    @property
    def streams(self) -> Mapping[int, StreamedMessage]:
        """Handlers of frames by message id. They decode a frame only when it is needed."""
        return self._streams

    def accepts(self, frame: Frame) -> bool:
        """Return True if the frame is from the vehicle's autopilot."""
        return frame.system_id == self.system_id and frame.component_id == self.component_id

    def receive(self, message: Message) -> None:
        """Process any message. Messages that report no state are ignored."""
        handler = self._handlers.get(message.ID)
        if handler is not None:
            handler(message)

    def expire(self, now: float) -> None:
        """Publish status texts whose end has not arrived in time. Call this about once a second."""
        self._publish_texts(self._texts.expire(now), self._source("Statustext"))

    def forget(self) -> None:
        """Make all states unknown after a reboot. The recent status texts are kept."""
        for stream in self._streams.values():
            stream.forget()
        for cell in self._cells.values():
            cell.forget()

    def close(self, error: BaseException) -> None:
        """Let all calls that wait for a state raise ``error``."""
        for cell in self._cells.values():
            cell.close(error)

    # ------------------------------------------------------------------------------- reading

    @property
    def cells(self) -> Mapping[str, StateCell[Any]]:
        return self._cells

    @property
    def mode_names(self) -> Mapping[int, str]:
        """Mode names from AVAILABLE_MODES by custom_mode, without those in a built-in table."""
        return self._mode_names

    @property
    def default_rates(self) -> Mapping[type[Message], float]:
        """Default rates in Hz by message class."""
        rates = {message_type(name): hz for name, hz in DEFAULT_RATES_HZ.items()}
        return {message_class: hz for message_class, hz in rates.items() if self.autopilot.sends(message_class)}

    def required_messages(self, name: str) -> tuple[type[Message], ...]:
        return tuple(STATES[name].requested_from(self.autopilot))

    @property
    def is_armed(self) -> bool:
        """True if the last heartbeat reports armed. False while this is unknown."""
        return self.armed.latest is True

    @property
    def is_confirmed_disarmed(self) -> bool:
        """True if the last heartbeat reports disarmed. False while this is unknown."""
        return self.armed.latest is False

    @property
    def is_vtol(self) -> bool:
        return bool(self.vtol_state.latest)

    @property
    def mode_name(self) -> str:
        mode = self.mode.latest
        return "unknown" if mode is None else mode.name

    def is_in(self, mode: Mode) -> bool:
        latest = self.mode.latest
        return latest is not None and latest.custom_mode == mode.custom_mode

    def texts_since(self, at: float) -> tuple[StatusText, ...]:
        """Return the status texts received at or after this time (64 at most), oldest first."""
        return self._texts.recent(at)

    def texts_about_failsafes(self) -> tuple[StatusText, ...]:
        """Return the last status texts (64 at most) about failsafes and problems in flight, oldest first.

        When a failsafe ends, the texts received until then are dropped.
        """
        return self._texts.about_failsafes()

    # ------------------------------------------------------------------------ updating cells

    def _cell_of(self, name: str) -> StateCell[Any]:
        return self._cells[name]

    def _time_of_arrival(self) -> float:
        return self._clock() if self._arrived_at is None else self._arrived_at

    def _source(self, class_name: str) -> Source:
        return Source(self.system_id, self.component_id, message_type(class_name).NAME)

    def _receiver(self, class_name: str, handler: Handler) -> Callable[[Any], None]:
        """Return a function that passes the autopilot's messages to ``handler``."""
        source = self._source(class_name)

        def on_message(message: Message) -> None:
            frame = message.received_frame
            # A message without a frame was not received from a link, but given by a program or a log.
            if frame is None or self.accepts(frame):
                with self._lock:
                    self._handle(handler, message, source, frame)

        return on_message

    def _handle(self, handler: Handler, message: Message, source: Source, frame: Frame | None) -> None:
        # Calls may be nested, because a handler may read a cell, which decodes another message.
        outer_arrived_at = self._arrived_at
        # The cells get the time at which the frame arrived as their timestamp.
        self._arrived_at = None if frame is None else frame.received_at
        try:
            handler(message, source)
        finally:
            self._arrived_at = outer_arrived_at

    def _handler(self, class_name: str) -> Handler:
        """Return the function that updates all cells for which messages of this class are a source."""
        special_handlers: Mapping[str, Handler] = {
            "AvailableModes": self._on_available_modes,
            "Statustext": self._on_status_text,
        }
        if class_name in special_handlers:
            return special_handlers[class_name]
        updates = [self._cell_update(field, source) for field, source in SOURCES[class_name]]

        def update_all(message: Any, source: Source) -> None:
            for update in updates:
                update(message, source)

        # Ignore heartbeats that a ground station or companion sends with the autopilot's ids.
        def on_heartbeat(message: Any, source: Source) -> None:
            if self._accept_heartbeat(message):
                update_all(message, source)

        if class_name == "Heartbeat":
            return on_heartbeat
        return updates[0] if len(updates) == 1 else update_all

    def _cell_update(self, field: StateField[Any], message_source: MessageSource[Any]) -> Handler:
        """Return the function that updates the cell of a state from one type of message."""
        cell, decode, context = self._cells[field.name], message_source.decode, self._context
        assert decode is not None
        # A message in LAZY is decoded when a cell is read. It must not replace a newer value from another message type.
        may_be_older = message_source.message in LAZY and len(field.sources) > 1

        def update(message: Any, source: Source) -> None:
            value = decode(message)
            if value is None:  # The message does not have the value, so the cell keeps its previous value.
                return
            if may_be_older and self._time_of_arrival() < cell.updated_at and _is_from_other_message(cell, source):
                return
            cell.set(value, source)

        def update_with_context(message: Any, source: Source) -> None:
            context.previous_value = cell.latest
            value = decode(message, context)
            if value is not None:
                # A message older than the value is not dropped, because the value may combine several message types.
                cell.set(value, source)

        chosen_update = update_with_context if message_source.needs_context else update

        def update_as_fallback(message: Any, source: Source) -> None:
            if not self._has_recent_better_value(cell, source):
                chosen_update(message, source)

        return update_as_fallback if message_source.fallback else chosen_update

    def _streamed_message(self, class_name: str, handler: Handler) -> StreamedMessage:
        """Return an object that keeps the frames of a message until a cell is read, and then calls ``handler``."""
        source, message_class = self._source(class_name), message_type(class_name)
        decode = decoder_of(message_class)

        def apply(frame: Frame, message: Message | None) -> None:
            decoded = decode(frame) if message is None else message
            self._handle(handler, decoded, source, frame)

        fields_and_sources = SOURCES[class_name]
        cells = [self._cells[field.name] for field, _ in fields_and_sources]
        instance_fields = (message_source.instance_field for _, message_source in fields_and_sources)
        instance_field = next((field_name for field_name in instance_fields if field_name is not None), None)
        instance_at = None if instance_field is None else offset_of(message_class, instance_field)
        return StreamedMessage(self.component_id, cells, instance_at, apply, self._lock)

    def _has_recent_better_value(self, cell: StateCell[Any], source: Source) -> bool:
        """Return True if a better message than the fallback ``source`` has reported the value recently."""
        return _is_from_other_message(cell, source) and self._time_of_arrival() - cell.updated_at < FALLBACK_DELAY_S

    # --------------------------------------------------------- messages with special handling

    def _accept_heartbeat(self, heartbeat: messages.Heartbeat) -> bool:
        """Record autopilot and base mode. Return False if the heartbeat is not an autopilot's."""
        if not is_autopilot(heartbeat):
            return False
        if not self._knows_autopilot:
            self._learn_autopilot(heartbeat)
        self._context.base_mode = heartbeat.base_mode
        status_before = self.system_status.latest or MavState.UNINIT
        if heartbeat.system_status < MavState.CRITICAL <= status_before:  # A failsafe has ended.
            self._texts.clear_failsafes()
        return True

    def _learn_autopilot(self, heartbeat: messages.Heartbeat) -> None:
        self.autopilot = autopilot_for(heartbeat)
        self._context.autopilot = self.autopilot
        self._knows_autopilot = True
        for name, cell in self._cells.items():
            cell.waits_for = STATES[name].waits_for(self.autopilot)

    def _on_available_modes(self, message: messages.AvailableModes, source: Source) -> None:
        self.has_available_modes = True
        name = self.autopilot.learn_mode_name(message.custom_mode, message.mode_name)
        can_store = message.custom_mode in self._mode_names or len(self._mode_names) < MAX_MODE_NAMES
        if name is not None and can_store:
            self._mode_names[message.custom_mode] = name

    def _on_status_text(self, message: messages.Statustext, source: Source) -> None:
        # A text gets the time at which it is processed. After a pause of the event loop, its time of arrival may be
        # earlier than the command to which the text is the vehicle's answer.
        joins_id_0 = self.autopilot.has_status_text_id_0
        self._publish_texts(self._texts.receive(message, self._clock(), joins_id_0=joins_id_0), source)

    def _publish_texts(self, texts: Iterable[StatusText], source: Source) -> None:
        for text in texts:
            self.status_text.set(text, source)


def _is_from_other_message(cell: StateCell[Any], source: Source) -> bool:
    """Return True if the value of the cell is from another message type than ``source``."""
    latest = cell.source
    return latest is not None and latest.message != source.message


def is_reported_on_ground(vehicle: States, *, max_age_s: float = LANDED_STATE_MAX_AGE_S) -> bool:
    """Return True if a report at most ``max_age_s`` old says that the vehicle is on the ground."""
    landed = vehicle.landed_state
    return landed.latest == MavLandedState.ON_GROUND and landed.age <= max_age_s


def height_above_home(telemetry: Telemetry) -> float | None:
    """Return the reported height above home in metres, or None if it is unknown."""
    here = telemetry.position.latest
    return None if here is None else here.altitude_relative_m


def altitude_amsl(telemetry: Telemetry) -> float | None:
    """Return the reported altitude above mean sea level in metres, or None if it is unknown.

    Changes of height are measured by this altitude, because PX4 corrects the altitude of home in flight.
    """
    here = telemetry.position.latest
    return None if here is None else here.altitude_amsl_m
