"""The blocking, thread-safe API of DroneKit-Python 2.9. Programs for DroneKit run unmodified.

```python
from aerokit.dronekit import VehicleMode, connect

vehicle = connect("127.0.0.1:14550", wait_ready=True)
print(vehicle.location.global_relative_frame)
vehicle.mode = VehicleMode("RTL")
vehicle.close()
```

A program with ``import dronekit`` runs unchanged with ``python -m aerokit.dronekit program.py`` (or ``aerokit run
program.py``). To port a program by one line, write ``import aerokit.dronekit as dronekit``. :func:`install`
makes ``import dronekit`` work in a test runner. docs/from-dronekit.md lists the differences from DroneKit.

Programs can move to the new API function by function: ``vehicle.sync`` is the blocking API on the same connection,
``vehicle.aio`` the asynchronous vehicle.
"""

from __future__ import annotations

import collections
import copy
import logging
import math
import struct
import time
from typing import TYPE_CHECKING, Any

from aerokit._internal.imports import lazy_exports
from aerokit.dronekit import util
from aerokit.dronekit.exceptions import APIException, TimeoutError  # noqa: A004 - DroneKit has it
from aerokit.dronekit.observers import HasObservers
from aerokit.dronekit.util import ErrprinterHandler
from aerokit.dronekit.values import (
    Attitude,
    Battery,
    Capabilities,
    GPSInfo,
    LocationGlobal,
    LocationGlobalRelative,
    LocationLocal,
    Rangefinder,
    SystemStatus,
    VehicleMode,
    Version,
    Wind,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from pymavlink import mavwp
    from pymavlink.dialects.v10 import ardupilotmega

    from aerokit.dronekit import _mavutil as mavutil
    from aerokit.dronekit.attributes import Locations
    from aerokit.dronekit.channels import Channels, ChannelsOverride
    from aerokit.dronekit.commands import Command, CommandSequence
    from aerokit.dronekit.gimbal import Gimbal
    from aerokit.dronekit.parameters import Parameters
    from aerokit.dronekit.runner import install
    from aerokit.dronekit.vehicle import Vehicle, connect, default_still_waiting_callback

monotonic = time  # DroneKit exports the package `monotonic`. Its only function is also in `time`.

basestring: tuple[type[str], type[bytes]] = (str, bytes)
"""The string types, for ``isinstance`` checks in programs that were written for Python 2."""

__all__ = [
    "APIException",
    "Attitude",
    "Battery",
    "Capabilities",
    "Channels",
    "ChannelsOverride",
    "Command",
    "CommandSequence",
    "ErrprinterHandler",
    "GPSInfo",
    "Gimbal",
    "HasObservers",
    "LocationGlobal",
    "LocationGlobalRelative",
    "LocationLocal",
    "Locations",
    "Parameters",
    "Rangefinder",
    "SystemStatus",
    "TimeoutError",
    "Vehicle",
    "VehicleMode",
    "Version",
    "Wind",
    "ardupilotmega",
    "basestring",
    "collections",
    "connect",
    "copy",
    "default_still_waiting_callback",
    "install",
    "logging",
    "math",
    "mavutil",
    "mavwp",
    "monotonic",
    "struct",
    "time",
    "util",
]

__getattr__: Callable[[str], Any]
__dir__: Callable[[], list[str]]
_later: list[str]
__getattr__, __dir__, _later = lazy_exports(
    __name__,
    {
        "aerokit.dronekit.attributes": ("Locations",),
        "aerokit.dronekit.channels": ("Channels", "ChannelsOverride"),
        "aerokit.dronekit.commands": ("Command", "CommandSequence"),
        "aerokit.dronekit.gimbal": ("Gimbal",),
        "aerokit.dronekit.parameters": ("Parameters",),
        "aerokit.dronekit.runner": ("install",),
        "aerokit.dronekit.vehicle": ("Vehicle", "connect", "default_still_waiting_callback"),
        "pymavlink.dialects.v10.ardupilotmega": ("ardupilotmega",),
        "pymavlink.mavutil": ("mavutil",),
        "pymavlink.mavwp": ("mavwp",),
    },
)
