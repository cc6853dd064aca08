"""``AutopilotDriver``: base class for your program's vehicle, which ground stations command."""

from __future__ import annotations

import math
from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING, Any

from aerokit.errors import InvalidArgument, NotSupported
from aerokit.mavlink.enums import MavCmd, MavFrame, MavModeFlag
from aerokit.missions.item import canonical_frame
from aerokit.onboard.commands import overrides

if TYPE_CHECKING:
    from aerokit.onboard.commands import CommandRequest, ComponentServices

FORCE = 21196
"""Value of param 2 in the MAVLink standard, which forces arming and disarming."""
FORCE_ARM = 2989
"""Value of param 2 in ArduPilot, which forces arming only."""
_REBOOT, _SHUTDOWN = 1, 2


class AutopilotDriver:
    """Base class for your program's vehicle; pass an instance to :meth:`OnboardComponent.add_autopilot`.

    Override the coroutines for the commands that the vehicle has; other commands are UNSUPPORTED. A coroutine returns
    when the vehicle has started to execute the command, or raises an exception to refuse it. HEARTBEAT reports the new
    armed state and mode after the coroutine has returned. A command to disarm cancels a running :meth:`arm`.
    """

    async def arm(self, force: bool) -> None:
        """Start the motors; ``force`` skips the checks."""
        raise NotImplementedError

    async def disarm(self, force: bool) -> None:
        """Stop the motors; with ``force`` even in flight."""
        raise NotImplementedError

    async def set_mode(self, custom_mode: int) -> None:
        """Change the flight mode."""
        raise NotImplementedError

    async def take_off(self, altitude_m: float | None) -> None:
        """Take off to an altitude above home; None means the default altitude."""
        raise NotImplementedError

    async def land(self) -> None:
        """Land here."""
        raise NotImplementedError

    async def return_to_launch(self) -> None:
        """Return to the launch position and land."""
        raise NotImplementedError

    async def reboot(self) -> None:
        """Restart the flight controller."""
        raise NotImplementedError

    async def shutdown(self) -> None:
        """Switch the flight controller off."""
        raise NotImplementedError

    async def terminate(self) -> None:
        """End the flight at once, even if the vehicle falls."""
        raise NotImplementedError


def add_autopilot(services: ComponentServices, driver: AutopilotDriver, set_flight_state: Callable[..., None]) -> None:
    """Serve the commands that ground stations send to a vehicle. ``set_flight_state`` changes the heartbeat."""

    async def call(name: str, *arguments: object) -> None:
        if not overrides(driver, AutopilotDriver, name):
            raise NotSupported(f"this vehicle does not support {name}")
        await services.commands.call(getattr(driver, name), *arguments)

    # The first argument of each handler is the request. The others are the parameters of the command, in order.

    async def arm_disarm(_: CommandRequest, is_armed: bool, force: float | None) -> None:
        is_forced = force == FORCE or (is_armed and force == FORCE_ARM)
        await call("arm" if is_armed else "disarm", is_forced)
        set_flight_state(is_armed=is_armed)

    async def set_mode(_: CommandRequest, base_mode: int, custom_mode: int) -> None:
        if not base_mode & MavModeFlag.CUSTOM_MODE_ENABLED:  # ArduPilot refuses a command without this flag as well.
            raise InvalidArgument(f"base_mode = {base_mode} is not allowed: CUSTOM_MODE_ENABLED (1) must be set")
        await call("set_mode", custom_mode)
        set_flight_state(custom_mode=custom_mode)

    async def take_off(request: CommandRequest) -> None:
        *_, altitude_m = request.params
        is_given = not math.isnan(altitude_m)
        is_relative = canonical_frame(request._command.altitude_frame) == MavFrame.GLOBAL_RELATIVE_ALT
        if is_given and not (is_relative and math.isfinite(altitude_m)):
            raise InvalidArgument(f"altitude = {altitude_m:g} is not allowed: it must be metres above home")
        await call("take_off", altitude_m if is_given else None)

    async def reboot(_: CommandRequest, action: int) -> None:
        if action not in (_REBOOT, _SHUTDOWN):
            raise NotSupported(f"action {action} is not supported")
        await call("reboot" if action == _REBOOT else "shutdown")

    async def terminate(_: CommandRequest, is_activated: bool) -> None:
        if is_activated:
            await call("terminate")

    def without_arguments(name: str) -> Callable[[CommandRequest], Awaitable[Any]]:
        async def run(_: CommandRequest) -> None:
            await call(name)

        return run

    add = services.commands.add
    # A command to disarm cancels a running arm() instead of being rejected until arm() has returned.
    add(MavCmd.COMPONENT_ARM_DISARM, arm_disarm, is_stop=lambda command: command.param1 == 0)
    add(MavCmd.DO_SET_MODE, set_mode)
    add(MavCmd.NAV_TAKEOFF, take_off)
    add(MavCmd.NAV_LAND, without_arguments("land"))
    add(MavCmd.NAV_RETURN_TO_LAUNCH, without_arguments("return_to_launch"))
    add(MavCmd.PREFLIGHT_REBOOT_SHUTDOWN, reboot)
    add(MavCmd.DO_FLIGHTTERMINATION, terminate)
