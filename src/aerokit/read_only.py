"""``ReadOnly``: objects whose public attributes cannot be assigned, because an assignment would look like an order."""

from __future__ import annotations

import inspect

from aerokit.wording import shown

__all__ = ["ReadOnly"]

CALLS = {
    "mode": "set_mode({value})",
    "mode_name": "set_mode({value})",
    "armed": "arm() or disarm()",
    "is_armed": "arm() or disarm()",
    "home": "set_home(place)",
    "position": "go_to(place)",
    "heading_deg": "set_heading(degrees)",
    "ground_speed_m_s": "set_speed(metres per second)",
    "current": "set_current(item)",
}
"""Attribute → the call that changes what it tells."""


class ReadOnly:
    """A base of public objects. ``vehicle.mode = "GUIDED"`` raises AttributeError, which names ``set_mode``.

    What the vehicle tells (cells, properties, parts) is refused; a program may add attributes of its own.
    """

    def __setattr__(self, name: str, value: object) -> None:
        found = inspect.getattr_static(type(self), name, None)
        is_setter = isinstance(found, property) and found.fset is not None
        if name.startswith("_") or is_setter or callable(found) or not hasattr(type(found), "__get__"):
            object.__setattr__(
                self, name, value
            )  # of the program, or made in the constructor; a method in a mock
            return
        text = f"{type(self).__name__}.{name} = {shown(value)} is not allowed"
        call = CALLS.get(name)
        if call is None or not hasattr(type(self), call.partition("(")[0]):
            raise AttributeError(f"{text}: it is only read")
        wait = "" if type(self).__module__.startswith("aerokit.sync") else "await "
        raise AttributeError(
            f"{text}: it tells what the vehicle does; write {wait}….{call.format(value=shown(value))}"
        )
