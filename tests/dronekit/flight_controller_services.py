"""Parameters and missions of the scripted flight controller, with the faults that firmware and radios have."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from flight_controller import FlightController, Received

__all__ = ["Item", "MissionService", "ParameterService"]

REAL32 = 9
INTEGERS = {1: "B", 2: "b", 3: "H", 4: "h", 5: "I", 6: "i"}
"""MAV_PARAM_TYPE → struct format."""
INVALID_SEQUENCE = 13
GLOBAL_FRAMES = (0, 3, 5, 6, 10, 11)


@dataclass
class ParameterService:
    """Lists, reads and sets.

    Attributes:
        values: name → value.
        types: name → MAV_PARAM_TYPE, REAL32 when it is not here.
        is_bytewise: integers go as PX4 has them, their bytes in the float.
        adjust: what becomes of a value that is set (rounding, limits).
        lost_echoes: how many answers to PARAM_SET get lost.
        lost_once: names that get lost in the next list.
        is_silent: nothing is answered, as by a vehicle without parameters.
    """

    controller: FlightController
    values: dict[str, float] = field(default_factory=lambda: {"FOO": 1.0, "BAR": 2.5, "THR_MIN": 130.0})
    types: dict[str, int] = field(default_factory=dict)
    is_bytewise: bool = False
    adjust: Callable[[str, float], float] = lambda _, value: value
    lost_echoes: int = 0
    lost_once: set[str] = field(default_factory=set)
    is_silent: bool = False

    @property
    def answers(self) -> dict[str, Callable[[Any], object]]:
        """Handlers by message name."""
        return {
            "PARAM_REQUEST_LIST": self._on_list,
            "PARAM_REQUEST_READ": self._on_read,
            "PARAM_SET": self._on_set,
        }

    def report(self, name: str, source: tuple[int, int] | None = None, **fields: Any) -> None:
        """Send PARAM_VALUE; fields are those it differs in."""
        usual = {
            "param_id": name.encode(),
            "param_value": self._encoded(name) if name in self.values else 0.0,
            "param_type": self.types.get(name, REAL32),
            "param_count": len(self.values),
            "param_index": list(self.values).index(name) if name in self.values else 65535,
        }
        self.controller.report("PARAM_VALUE", source=source, **{**usual, **fields})

    def _encoded(self, name: str) -> float:
        kind = self.types.get(name, REAL32)
        if kind == REAL32 or not self.is_bytewise:
            return self.values[name]
        raw = struct.pack(f"<{INTEGERS[kind]}", int(self.values[name])).ljust(4, b"\0")
        return float(struct.unpack("<f", raw)[0])

    def _decoded(self, value: float, kind: int) -> float:
        if kind == REAL32 or not self.is_bytewise:
            return value
        return float(struct.unpack_from(f"<{INTEGERS[kind]}", struct.pack("<f", value))[0])

    def _on_list(self, _: Received) -> None:
        if self.is_silent:
            return
        lost, self.lost_once = self.lost_once, set()
        for name in list(self.values):
            if name not in lost:
                self.report(name)

    def _on_read(self, frame: Received) -> None:
        names = list(self.values)
        if self.is_silent:
            return
        if 0 <= frame.param_index < len(names):
            self.report(names[frame.param_index])
        elif frame.param_index == -1 and frame.param_id in self.values:
            self.report(frame.param_id)

    def _on_set(self, frame: Received) -> None:
        name = frame.param_id
        kind = self.types.get(name, REAL32)
        if self.is_silent or name not in self.values:
            return
        if self.is_bytewise and frame.param_type != kind:  # PX4 refuses a wrong type and reports the old value.
            self.report(name)
            return
        self.values[name] = self.adjust(name, self._decoded(frame.param_value, kind))
        if self.lost_echoes:
            self.lost_echoes -= 1
        else:
            self.report(name)


class Item(NamedTuple):
    """A mission item as the vehicle keeps it; x and y in degrees."""

    command: int
    x: float
    y: float
    z: float
    frame: int = 3
    params: tuple[float, float, float, float] = (0, 0, 0, 0)


@dataclass
class MissionService:
    """Mission downloads and uploads like ArduPilot's: item 0 is home, and an upload does not change it.

    Attributes:
        items: the stored items, home included.
        has_home: whether item 0 is home (ArduPilot) or an item like others (PX4).
        asks_int: whether items are requested with MISSION_REQUEST_INT.
        lost: number of item → how many of its transmissions get lost (downloads).
        result: MAV_MISSION_RESULT that an upload ends with; refused items are not kept.
        is_mute: no upload is answered.
    """

    controller: FlightController
    items: list[Item] = field(default_factory=list)
    has_home: bool = True
    asks_int: bool = True
    lost: dict[int, int] = field(default_factory=dict)
    result: int = 0
    is_mute: bool = False
    _count: int = 0
    _coming: list[Item] = field(default_factory=list)

    @property
    def answers(self) -> dict[str, Callable[[Any], object]]:
        """Handlers by message name."""
        return {
            "MISSION_REQUEST_LIST": self._on_list,
            "MISSION_REQUEST": lambda frame: self._on_request(frame, is_int=False),
            "MISSION_REQUEST_INT": lambda frame: self._on_request(frame, is_int=True),
            "MISSION_CLEAR_ALL": self._on_clear,
            "MISSION_COUNT": self._on_count,
            "MISSION_ITEM": self._on_item,
            "MISSION_ITEM_INT": self._on_item,
            "MISSION_SET_CURRENT": lambda frame: self.controller.report("MISSION_CURRENT", seq=frame.seq),
        }

    def _reply(self, frame: Received, name: str, /, **fields: Any) -> None:
        me: dict[str, Any] = {"target_system": frame.system, "target_component": frame.component}
        kind = getattr(frame.message, "mission_type", 0)
        self.controller.report(name, mission_type=kind, **me, **fields)

    def _on_list(self, frame: Received) -> None:
        is_mission = getattr(frame.message, "mission_type", 0) == 0
        self._reply(frame, "MISSION_COUNT", count=len(self.items) if is_mission else 0)

    def _on_request(self, frame: Received, *, is_int: bool) -> None:
        seq = frame.seq
        if self.lost.get(seq, 0):
            self.lost[seq] -= 1
        elif seq < len(self.items):
            self._reply(frame, "MISSION_ITEM_INT" if is_int else "MISSION_ITEM", **self._fields(seq, is_int))
        else:
            self._reply(frame, "MISSION_ACK", type=INVALID_SEQUENCE)

    def _fields(self, seq: int, is_int: bool) -> dict[str, Any]:
        item = self.items[seq]
        scale = (1e7 if item.frame in GLOBAL_FRAMES else 1e4) if is_int else 1
        x, y = item.x * scale, item.y * scale
        params = {f"param{number}": value for number, value in enumerate(item.params, 1)}
        place = {"x": round(x) if is_int else x, "y": round(y) if is_int else y, "z": item.z}
        return {
            "seq": seq,
            "command": item.command,
            "frame": item.frame,
            "autocontinue": 1,
            **params,
            **place,
        }

    def _on_clear(self, frame: Received) -> None:
        if self.is_mute:
            return
        if getattr(frame.message, "mission_type", 0) == 0:
            self.items = []
        self._reply(frame, "MISSION_ACK", type=0)

    def _on_count(self, frame: Received) -> None:
        if self.is_mute:
            return
        self._count, self._coming = frame.count, []
        if self._count:
            self._ask(frame)
        else:
            self._reply(frame, "MISSION_ACK", type=0)

    def _ask(self, frame: Received) -> None:
        name = "MISSION_REQUEST_INT" if self.asks_int else "MISSION_REQUEST"
        self._reply(frame, name, seq=len(self._coming))

    def _on_item(self, frame: Received) -> None:
        if frame.current == 2:  # fly there; not of a mission
            self.controller.report("MISSION_ACK", type=0)
            return
        if frame.seq != len(self._coming) or len(self._coming) >= self._count:
            return
        scale = (1e-7 if frame.frame in GLOBAL_FRAMES else 1e-4) if frame.name == "MISSION_ITEM_INT" else 1
        params = (frame.param1, frame.param2, frame.param3, frame.param4)
        place = (round(frame.x * scale, 7), round(frame.y * scale, 7), frame.z)
        self._coming.append(Item(frame.command, *place, frame.frame, params))
        if len(self._coming) < self._count:
            self._ask(frame)
            return
        if self.result == 0:
            self._keep()
        self._reply(frame, "MISSION_ACK", type=self.result)

    def _keep(self) -> None:
        if not self.has_home:
            self.items = self._coming
            return
        home = self.items[0] if self.items else Item(16, -35.363261, 149.16523, 584.0, 0)
        self.items = [home, *self._coming[1:]]
