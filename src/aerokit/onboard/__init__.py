"""This program as a MAVLink component: `aerokit.component`, and ready-made parts for it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from aerokit._internal.imports import lazy_exports

if TYPE_CHECKING:
    from collections.abc import Callable

    from aerokit.onboard.arguments import Param as Param
    from aerokit.onboard.arguments import Range as Range
    from aerokit.onboard.autopilot import AutopilotDriver as AutopilotDriver
    from aerokit.onboard.camera import CameraDriver as CameraDriver
    from aerokit.onboard.camera import Photo as Photo
    from aerokit.onboard.camera import Storage as Storage
    from aerokit.onboard.commands import CommandRequest as CommandRequest
    from aerokit.onboard.component import OnboardComponent as OnboardComponent
    from aerokit.onboard.devices import WinchDriver as WinchDriver
    from aerokit.onboard.devices import WinchReport as WinchReport
    from aerokit.onboard.gimbal import GimbalDriver as GimbalDriver
    from aerokit.onboard.gimbal import GimbalTarget as GimbalTarget
    from aerokit.onboard.identity import Identity as Identity
    from aerokit.onboard.missions import ComponentMissions as ComponentMissions
    from aerokit.onboard.opening import component as component
    from aerokit.onboard.parameters import ComponentParameters as ComponentParameters
    from aerokit.onboard.sources import ComponentSources as ComponentSources
    from aerokit.protocols.servers.commands import CommandResult as CommandResult

__getattr__: Callable[[str], Any]
__dir__: Callable[[], list[str]]
__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "aerokit.onboard.arguments": ("Param", "Range"),
        "aerokit.onboard.autopilot": ("AutopilotDriver",),
        "aerokit.onboard.camera": ("CameraDriver", "Photo", "Storage"),
        "aerokit.onboard.commands": ("CommandRequest",),
        "aerokit.onboard.component": ("OnboardComponent",),
        "aerokit.onboard.devices": ("WinchDriver", "WinchReport"),
        "aerokit.onboard.gimbal": ("GimbalDriver", "GimbalTarget"),
        "aerokit.onboard.identity": ("Identity",),
        "aerokit.onboard.missions": ("ComponentMissions",),
        "aerokit.onboard.opening": ("component",),
        "aerokit.onboard.parameters": ("ComponentParameters",),
        "aerokit.onboard.sources": ("ComponentSources",),
        "aerokit.protocols.servers.commands": ("CommandResult",),
    },
)
