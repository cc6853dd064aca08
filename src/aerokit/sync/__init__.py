"""The blocking twin of aerokit: the same names and arguments, for programs without ``async``.

```python
import aerokit.sync

with aerokit.sync.connect("udpin:0.0.0.0:14550") as vehicle:
    vehicle.wait_ready()
    vehicle.arm()
    vehicle.take_off(altitude_m=10)
    print(vehicle.position.value, vehicle.position.age)
    vehicle.land()
```

One event loop runs on a thread of its own for each connection and ends with it: heartbeats go out and
messages come in whatever the program does meanwhile. Reading a value (``.value``, ``.latest``, ``.age``,
``.fresh(within=1)``) takes a snapshot and never crosses a thread. Everything that waits does so on the loop,
and Ctrl-C ends it there: a take-off or a flight somewhere that is interrupted leaves the vehicle holding its
place. Exceptions come through as they are. Any thread may call; functions that are handed in (predicates,
``on_progress``) run on the loop's thread, so they must be quick and cannot call anything that blocks
(:class:`aerokit.errors.BusyError`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from aerokit._internal.imports import lazy_exports

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.sync.fleet_twins import Fleet as Fleet
    from aerokit.sync.fleet_twins import Selection as Selection
    from aerokit.sync.fleet_twins import fleet as fleet
    from aerokit.sync.twins import Connection as Connection
    from aerokit.sync.twins import Guided as Guided
    from aerokit.sync.twins import SetpointStream as SetpointStream
    from aerokit.sync.twins import StateCell as StateCell
    from aerokit.sync.twins import Subscription as Subscription
    from aerokit.sync.twins import Vehicle as Vehicle
    from aerokit.sync.twins import connect as connect
    from aerokit.sync.twins import open_connection as open_connection

__getattr__: Callable[[str], Any]
__dir__: Callable[[], list[str]]
__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "aerokit.sync.fleet_twins": ("Fleet", "Selection", "fleet"),
        "aerokit.sync.twins": (
            "Connection",
            "Guided",
            "SetpointStream",
            "StateCell",
            "Subscription",
            "Vehicle",
            "connect",
            "open_connection",
        ),
    },
)
