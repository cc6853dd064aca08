"""The simulated vehicles that the command line makes."""

from __future__ import annotations

import inspect
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from aerokit.sim import SimulatedVehicle

__all__ = ["simulated_fleet", "simulated_vehicle"]


def simulated_vehicle(name: str, **options: Any) -> SimulatedVehicle:
    """A vehicle of a kind of `aerokit.sim.kinds`, just switched on; ``options`` are its class's.

    InvalidArgument when it has no such option or parameter. ``boot_text`` is for those that have one.
    """
    from aerokit.errors import InvalidArgument
    from aerokit.sim.kinds import kind_class, simulated

    taken = _options_of(kind_class(name))
    if "boot_text" not in taken:
        options.pop("boot_text", None)
    for option in options:
        if option not in taken:
            raise InvalidArgument(f"the simulated {name} has no {option}")
    return simulated(name, **options)


def simulated_fleet(
    name: str,
    count: int,
    *,
    system_id: int = 1,
    home: tuple[float, float, float] | None = None,
    spacing_m: float = 5.0,
    seed: int = 0,
    **options: Any,
) -> list[SimulatedVehicle]:
    """Vehicles side by side eastwards from ``home``, or `aerokit.sim.HOME`; system ids and seeds count up.

    The name of a .tlog file gives the one vehicle of that recording, to which nothing else applies.
    """
    from aerokit.errors import InvalidArgument
    from aerokit.sim.local_frame import HOME, GlobalPoint, LocalFrame

    if name.endswith(".tlog"):
        return [_recorded(name, count)]
    if system_id + count - 1 > 255:
        raise InvalidArgument(f"{count} vehicles from system id {system_id} on: the last would be above 255")
    home = home or HOME
    frame = LocalFrame(GlobalPoint(round(home[0] * 1e7), round(home[1] * 1e7), home[2]))
    places = [frame.to_global(0.0, number * spacing_m, 0.0) for number in range(count)]
    return [
        simulated_vehicle(
            name,
            home=(place.latitude_e7 / 1e7, place.longitude_e7 / 1e7, home[2]),
            system_id=system_id + number,
            seed=seed + number,
            **options,
        )
        for number, place in enumerate(places)
    ]


def _recorded(path: str, count: int) -> SimulatedVehicle:
    from aerokit.errors import InvalidArgument
    from aerokit.sim.recorded import RecordedVehicle

    if count != 1:
        raise InvalidArgument(f"{path} is one vehicle; count = {count}")
    return RecordedVehicle(path)


def _options_of(kind: type) -> set[str]:
    """What its constructor takes, with what it passes on to those of its bases."""
    names: set[str] = set()
    for cls in kind.__mro__:
        if "__init__" not in vars(cls):
            continue
        parameters = inspect.signature(vars(cls)["__init__"]).parameters.values()
        names |= {parameter.name for parameter in parameters}
        if not any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters):
            break
    return names
