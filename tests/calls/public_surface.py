"""The public calls, read from the library itself, so that new ones are found."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from types import FunctionType
from typing import Any, NamedTuple

import aerokit
from aerokit.connection.bus import Subscription
from aerokit.connection.cells import Changes, StateCell
from aerokit.connection.connection import Connection
from aerokit.vehicle.calibration.calibration import Calibration, CalibrationControl
from aerokit.vehicle.camera.cameras import Camera
from aerokit.vehicle.camera.link import CameraBlock
from aerokit.vehicle.camera.photos import PhotoInterval
from aerokit.vehicle.commanding.follow import FollowStream
from aerokit.vehicle.commanding.guided import Guided, SetpointStream
from aerokit.vehicle.commanding.posted import PostedOrder
from aerokit.vehicle.commanding.sticks import StickStream
from aerokit.vehicle.components.component import Component
from aerokit.vehicle.components.settings import Settings
from aerokit.vehicle.devices.actuators import Actuators
from aerokit.vehicle.devices.gripper import Gripper
from aerokit.vehicle.devices.shell import Shell
from aerokit.vehicle.devices.winch import Winch
from aerokit.vehicle.external.external import External
from aerokit.vehicle.external.streams import MeasurementStream
from aerokit.vehicle.files.files import Files
from aerokit.vehicle.files.log_stream import LogStream
from aerokit.vehicle.files.logs import Logs
from aerokit.vehicle.gimbal.control import GimbalControl
from aerokit.vehicle.gimbal.gimbal import Gimbal, Gimbals
from aerokit.vehicle.gimbal.rates import GimbalRates
from aerokit.vehicle.missions.mission import MissionControl
from aerokit.vehicle.missions.plans import FenceControl, RallyControl
from aerokit.vehicle.parameters.parameters import Parameters
from aerokit.vehicle.parameters.transaction import TemporaryParameters, Transaction
from aerokit.vehicle.rtk.ntrip import NtripClient
from aerokit.vehicle.rtk.rtk import Rtk

__all__ = ["CLASSES", "FUNCTIONS", "Member", "awaited", "members", "own_classes_in"]

CLASSES: tuple[type, ...] = (
    aerokit.Vehicle,
    Guided,
    SetpointStream,
    FollowStream,
    StickStream,
    External,
    MeasurementStream,
    Gimbal,
    Component,
    Gimbals,
    GimbalControl,
    GimbalRates,
    Camera,
    CameraBlock,
    PhotoInterval,
    PostedOrder,
    Parameters,
    TemporaryParameters,
    Transaction,
    Settings,
    MissionControl,
    FenceControl,
    RallyControl,
    CalibrationControl,
    Calibration,
    Rtk,
    NtripClient,
    Files,
    Logs,
    LogStream,
    Actuators,
    Gripper,
    Winch,
    Shell,
    StateCell,
    Changes,
    Subscription,
    Connection,
)
"""The objects that a program gets; a test finds those that are missing here."""
FUNCTIONS: tuple[Callable[..., Any], ...] = (aerokit.connect, aerokit.open_connection)

ENTERED = ("__aenter__", "__anext__")
"""A member of one of these classes is awaited although it is not a coroutine function."""


class Member(NamedTuple):
    """One public function of a class, or of the package."""

    owner: type | None
    name: str
    function: Callable[..., Any]

    @property
    def qualified(self) -> str:
        """The qualified name by the class that programs use, not by the defining class."""
        return self.name if self.owner is None else f"{self.owner.__name__}.{self.name}"

    @property
    def docstring(self) -> str:
        return inspect.getdoc(self.function) or ""

    @property
    def is_awaited(self) -> bool:
        """A coroutine function, or an asynchronous context manager or iterator, or what gives one."""
        plain = inspect.unwrap(self.function)
        if inspect.iscoroutinefunction(plain) or inspect.isasyncgenfunction(plain):
            return True
        given = str(inspect.signature(plain).return_annotation).partition("[")[0]
        return any(cls.__name__ == given and _is_entered(cls) for cls in CLASSES)


def _is_entered(cls: type) -> bool:
    return any(hasattr(cls, name) for name in ENTERED)


def members() -> Iterator[Member]:
    """Every public function, properties left out: those never wait."""
    for function in FUNCTIONS:
        yield Member(None, function.__name__, function)
    for cls in CLASSES:
        for name in dir(cls):
            found = inspect.getattr_static(cls, name)
            found = found.__func__ if isinstance(found, (classmethod, staticmethod)) else found
            if not name.startswith("_") and isinstance(found, FunctionType):
                yield Member(cls, name, found)


def awaited() -> dict[str, Member]:
    """Return everything that a program awaits, enters or iterates, by qualified name."""
    return {member.qualified: member for member in members() if member.is_awaited}


def own_classes_in(vehicle: aerokit.Vehicle) -> Iterator[type]:
    """The classes of the public attributes of a vehicle that have something to await."""
    for name in dir(vehicle):
        if not name.startswith("_"):
            cls = type(getattr(vehicle, name))
            coroutines = [attribute for attribute in vars(cls).values() if inspect.iscoroutinefunction(attribute)]
            if cls.__module__.startswith("aerokit") and coroutines:
                yield cls
