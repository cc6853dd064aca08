"""Winch, gripper and arm authorizer of a component."""

from __future__ import annotations

import math
from collections.abc import Awaitable, Callable
from functools import partial
from typing import TYPE_CHECKING, Any

from aerokit._internal.values import Snapshot
from aerokit.errors import InvalidArgument, NotSupported
from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import GripperActions, MavArmAuthDeniedReason, MavCmd, MavResult, MavSeverity, WinchActions
from aerokit.onboard.commands import overrides, result_of
from aerokit.onboard.host import error_text
from aerokit.protocols.servers.commands import CommandResult

if TYPE_CHECKING:
    from aerokit.onboard.commands import CommandRequest, ComponentServices

Authorize = Callable[[int], "float | Awaitable[float]"]

MAX_AUTHORIZATION_S = 255
_TEMPERATURE_UNKNOWN = 0x7FFF


class WinchReport(Snapshot):
    """State of a winch, sent as WINCH_STATUS; unknown values are None. ``flags`` are MAV_WINCH_STATUS_FLAG bits."""

    length_m: float | None = None
    speed_m_s: float | None = None
    tension_kg: float | None = None
    flags: int = 0


class WinchDriver:
    """Base class for your program's winch; pass an instance to :meth:`OnboardComponent.add_winch`.

    Override the coroutines for the actions that the winch has; other actions are UNSUPPORTED. A coroutine must return
    only when its action has ended. Until then, the sender gets IN_PROGRESS, and the coroutine is cancelled by
    COMMAND_CANCEL or by the winch action HOLD.
    """

    async def relax(self) -> None:
        """Let the line run freely."""
        raise NotImplementedError

    async def pay_out(self, length_m: float, rate_m_s: float) -> None:
        """Wind the line out (positive length) or in (negative length); the rate is above 0."""
        raise NotImplementedError

    async def set_rate(self, rate_m_s: float) -> None:
        """Wind the line out (positive rate) or in (negative rate) until the next command.

        If the line still runs when the component's block ends, aerokit calls :meth:`hold` or, if the winch does not
        implement it, this method with 0.
        """
        raise NotImplementedError

    async def lock(self) -> None:
        """Lock the line in its storage position."""
        raise NotImplementedError

    async def deliver(self) -> None:
        """Lower the payload, detach it and retract the line."""
        raise NotImplementedError

    async def hold(self) -> None:
        """Stop and hold the line."""
        raise NotImplementedError

    async def retract(self) -> None:
        """Retract the line completely."""
        raise NotImplementedError

    async def load_line(self) -> None:
        """Load the line onto the drum."""
        raise NotImplementedError

    async def abandon_line(self) -> None:
        """Let the line run out completely."""
        raise NotImplementedError

    async def load_payload(self) -> None:
        """Lower the hook so that a payload can be attached."""
        raise NotImplementedError

    def report(self) -> WinchReport:
        """Return the state of the winch; called at 5 Hz."""
        return WinchReport()


_WINCH_METHODS: dict[int, str] = {
    WinchActions.RELAXED: "relax",
    WinchActions.RELATIVE_LENGTH_CONTROL: "pay_out",
    WinchActions.RATE_CONTROL: "set_rate",
    WinchActions.LOCK: "lock",
    WinchActions.DELIVER: "deliver",
    WinchActions.HOLD: "hold",
    WinchActions.RETRACT: "retract",
    WinchActions.LOAD_LINE: "load_line",
    WinchActions.ABANDON_LINE: "abandon_line",
    WinchActions.LOAD_PAYLOAD: "load_payload",
}
STATUS_HZ = 5.0


def _check_instance(services: ComponentServices, instance: float | None) -> None:
    # DO_GRIPPER in common.xml: the instance is a number from 1 on, or a component id; 0 means all instances.
    component_id = services.host.component_id
    if instance not in (None, 0, 1, component_id):
        raise InvalidArgument(
            f"instance = {instance} is not allowed: the only device of this component is 1, or {component_id}"
        )


def add_winch(services: ComponentServices, winch: WinchDriver) -> None:
    # The arguments are the parameters of DO_WINCH, in order.
    async def do_winch(
        _: CommandRequest, instance: float | None, action: int, length: float | None, rate: float | None
    ) -> None:
        _check_instance(services, instance)
        method = _WINCH_METHODS.get(action, "")
        if not method or not overrides(winch, WinchDriver, method):
            raise NotSupported(f"this winch does not support action {action}")
        arguments = _winch_arguments(method, length, rate)
        if method == "set_rate":  # The line then moves until it is stopped, at the latest when the component ends.
            can_hold = overrides(winch, WinchDriver, "hold")
            services.stop_functions["winch"] = winch.hold if can_hold else partial(winch.set_rate, 0.0)
        await services.commands.call(getattr(winch, method), *arguments)
        if method != "set_rate" or rate == 0:
            services.stop_functions.pop("winch", None)

    def status() -> m.WinchStatus:
        report = winch.report()
        values = (report.length_m, report.speed_m_s, report.tension_kg)
        length, speed, tension = (math.nan if value is None else value for value in values)
        time_us = round(services.host.connection.unix_time() * 1e6)
        voltage = current = math.nan
        return m.WinchStatus(time_us, length, speed, tension, voltage, current, _TEMPERATURE_UNKNOWN, report.flags)

    # HOLD stops the line at once, even while another action of DO_WINCH is running.
    services.commands.add(MavCmd.DO_WINCH, do_winch, is_stop=lambda command: command.param2 == WinchActions.HOLD)
    services.add_message(m.WinchStatus, status, STATUS_HZ)


def _winch_arguments(method: str, length: float | None, rate: float | None) -> tuple[float, ...]:
    # A parameter that the sender has left out is NaN in the message, and None here.
    if method == "pay_out":
        if length is None or rate is None:
            raise InvalidArgument("this action needs length and rate; NaN is not allowed")
        if rate <= 0:
            raise InvalidArgument(f"rate = {rate:g} is not allowed: it must be above 0")
        return length, rate
    if method == "set_rate":
        if rate is None:
            raise InvalidArgument("this action needs rate; NaN is not allowed")
        return (rate,)
    return ()


def add_gripper(
    services: ComponentServices, grab: Callable[[], Awaitable[Any]], release: Callable[[], Awaitable[Any]]
) -> None:
    # The arguments are the parameters of DO_GRIPPER, in order.
    async def do_gripper(_: CommandRequest, instance: float | None, action: GripperActions) -> None:
        _check_instance(services, instance)
        if action == GripperActions.RELEASE:
            await services.commands.call(release)
        elif action == GripperActions.GRAB:
            await services.commands.call(grab)
        else:
            raise NotSupported(f"this gripper does not support {action.name}")

    services.commands.add(MavCmd.DO_GRIPPER, do_gripper)


def add_arm_authorizer(services: ComponentServices, authorize: Authorize) -> None:
    async def arm_authorization(request: CommandRequest, system_id: int) -> CommandResult:
        try:
            # PX4 sends 0 instead of its system id (ArmAuthorization.cpp).
            answer = await services.commands.call(authorize, system_id or request.sender.system)
        except Exception as error:
            services.host.send_text(MavSeverity.WARNING, f"arming denied: {error_text(error)}")
            result = result_of(error)
            # NONE: the authorizer denied, and its reason is in the status text. GENERIC: the authorizer failed, so it
            # gave no reason.
            reason = MavArmAuthDeniedReason.NONE if result == MavResult.DENIED else MavArmAuthDeniedReason.GENERIC
            return CommandResult(MavResult.DENIED, detail=reason)
        if isinstance(answer, CommandResult):
            return answer
        if not 0 < answer <= MAX_AUTHORIZATION_S:
            raise ValueError(
                f"the authorizer returned {answer!r}; it must return seconds, above 0 and at most {MAX_AUTHORIZATION_S}"
            )
        # The standard puts the seconds into `progress`; PX4 reads them from `result_param2` (ArmAuthorization.cpp).
        return CommandResult(MavResult.ACCEPTED, progress=math.ceil(answer), detail=math.ceil(answer))

    services.commands.add(MavCmd.ARM_AUTHORIZATION_REQUEST, arm_authorization)
