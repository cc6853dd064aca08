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

Each connection has an event loop on a thread of its own, so that it sends heartbeats and receives messages while the
program does other things. Reading a value (``.value``, ``.latest``, ``.age``, ``.fresh(within=1)``) takes a snapshot
without waiting for the loop. Calls that wait run on the loop. Ctrl-C cancels them: an interrupted take-off or ``go_to``
leaves the vehicle holding position. Exceptions are those of the asynchronous API. All objects can be used from any
thread. Functions passed as arguments (predicates, ``on_progress``) run on the loop's thread: they must be quick, and
blocking calls in them raise :class:`aerokit.errors.BusyError`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from aerokit._internal.imports import lazy_exports

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.sync.component_twins import OnboardComponent as OnboardComponent
    from aerokit.sync.component_twins import component as component
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
        "aerokit.sync.component_twins": ("OnboardComponent", "component"),
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
