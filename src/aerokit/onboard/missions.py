"""Missions, fences and rally points of a component."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from aerokit._internal.arguments import checks_arguments
from aerokit.errors import InvalidArgument
from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavCmd, MavMissionResult, MavMissionType
from aerokit.missions import MissionItem
from aerokit.missions.check import check_items
from aerokit.protocols.servers.host import Channel, ComponentIds, sender_of
from aerokit.protocols.servers.missions import MAX_CLIENTS, AnyRequest, MissionServer

if TYPE_CHECKING:
    from aerokit.onboard.commands import CommandRequest, ComponentServices

_TYPES_BY_KIND = {"mission": MavMissionType.MISSION, "fence": MavMissionType.FENCE, "rally": MavMissionType.RALLY}


@checks_arguments
class ComponentMissions:
    """Missions, fences and rally points that other programs upload to this component.

    By default every valid list is accepted and stored. :meth:`on_upload` registers a function that may refuse a list.
    """

    def __init__(self, services: ComponentServices) -> None:
        self._host, self._tasks, self._commands = services.host, services.tasks, services.commands
        self._server = _ConsistentMissionServer(self._host, self._accept_or_refuse, on_set_current=self._set_current)
        self._on_upload: Callable[[str, tuple[MissionItem, ...]], Any] | None = None
        self._on_current: Callable[[int], object] | None = None
        self._commands.add(MavCmd.DO_SET_MISSION_CURRENT, self._do_set_current)
        services.streams.builders[m.MissionCurrent.ID] = lambda _: [self._server.current_message()]

    def items(self, kind: str = "mission") -> tuple[MissionItem, ...]:
        """Return the items of ``"mission"``, ``"fence"`` or ``"rally"``; InvalidArgument for other kinds."""
        return self._server.lists[_type_of(kind)]

    def replace(self, items: Sequence[MissionItem], kind: str = "mission") -> None:
        """Replace the items of one kind.

        Raises:
            InvalidArgument: there is no such kind.
        """
        self._server.store(_type_of(kind), items)

    def on_upload(
        self, function: Callable[[str, tuple[MissionItem, ...]], Any]
    ) -> Callable[[str, tuple[MissionItem, ...]], Any]:
        """Decorator: ``function(kind, items)`` accepts or refuses each upload, before it is stored and acknowledged.

        To refuse a list, the function returns False or a MAV_MISSION_RESULT, or raises an exception. Its text is sent
        as a status text, and the result is INVALID for InvalidArgument and ValueError, otherwise ERROR. The function
        may be a coroutine function. An empty list is a request to clear the list.
        """
        self._on_upload = function
        return function

    def on_set_current(self, function: Callable[[int], object]) -> Callable[[int], object]:
        """Decorator: ``function(index)`` continues the mission at an item.

        A request to change the current item is refused if the function returns False or raises an exception. Without a
        function, all requests are refused.

        Raises:
            InvalidArgument: the function is a coroutine function.
        """
        if inspect.iscoroutinefunction(function):
            raise InvalidArgument("on_set_current needs a plain function, because the request is answered at once")
        self._on_current = function
        return function

    @property
    def current(self) -> int:
        """Index of the current item, as MISSION_CURRENT reports it."""
        return self._server.current

    def set_current(self, index: int) -> None:
        """Report the item that is executed now (MISSION_CURRENT).

        Raises:
            InvalidArgument: there is no such item.
        """
        if not 0 <= index < len(self.items()):
            raise InvalidArgument(f"index = {index} is not allowed: the mission has {len(self.items())} items")
        self._server.current = index
        self._host.send(self._server.current_message())

    def report_reached(self, index: int) -> None:
        """Report that an item was reached (MISSION_ITEM_REACHED)."""
        self._host.send(m.MissionItemReached(index))

    def _accept_or_refuse(
        self, mission_type: int, items: tuple[MissionItem, ...], answer: Callable[[int], None]
    ) -> None:
        """Call ``answer`` with the MAV_MISSION_RESULT of an upload, now or later."""
        kind = next(name for name, number in _TYPES_BY_KIND.items() if number == mission_type)
        function = self._on_upload
        verdict: Any = None
        try:
            check_items(items, mission_type)
            if function is not None:
                verdict = self._commands.start_call(function, kind, items)
            result_now = None if inspect.isawaitable(verdict) else _result_of(verdict)
        except Exception as error:
            answer(self._report_refusal(kind, error))
            return
        if result_now is not None:
            answer(result_now)
            return

        async def answer_later() -> None:
            result = int(MavMissionResult.OPERATION_CANCELLED)  # the answer if this task is cancelled
            try:
                result = _result_of(await verdict)
            except Exception as error:
                result = self._report_refusal(kind, error)
            finally:
                answer(result)

        self._tasks.start(answer_later, "aerokit mission upload")

    def _report_refusal(self, subject: str, error: Exception) -> int:
        """Send the error as a status text, and return the MAV_MISSION_RESULT for it."""
        self._host.report_error(f"{subject} refused", error)
        is_invalid = isinstance(error, ValueError)
        return MavMissionResult.INVALID if is_invalid else MavMissionResult.ERROR

    def _set_current(self, index: int) -> bool:
        if self._on_current is None:
            return False
        try:
            return self._on_current(index) is not False  # A function that returns None accepts the item.
        except Exception as error:
            self._report_refusal("set_current", error)
            return False

    async def _do_set_current(self, _: CommandRequest, index: int) -> None:
        is_accepted = False
        if 0 <= index < len(self.items()) and self._on_current is not None:
            # This coroutine runs on the event loop, so it may send. The program's function may run in a thread.
            is_accepted = await self._commands.call(self._on_current, index) is not False
        if not is_accepted:
            raise InvalidArgument(f"the mission cannot continue at item {index}")
        self.set_current(index)


class _Download(NamedTuple):
    items: tuple[MissionItem, ...]
    used_at: float  # time of the last request


class _ConsistentMissionServer(MissionServer):
    """Sends the items that the MISSION_COUNT of a download has announced, even if they are replaced meanwhile.

    Otherwise the client would get a mixture of two plans.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._downloads: dict[tuple[ComponentIds, int], _Download] = {}  # by client and MAV_MISSION_TYPE

    def _on_request_list(self, request: m.MissionRequestList, channel: Channel) -> None:
        super()._on_request_list(request, channel)
        kind = request.mission_type
        if kind in self.lists:
            self._downloads.pop((sender_of(request), kind), None)
            self._downloads[sender_of(request), kind] = _Download(self.lists[kind], self._host.now)
            if len(self._downloads) > MAX_CLIENTS:
                del self._downloads[next(iter(self._downloads))]

    def _requested_item(self, request: AnyRequest) -> MissionItem | None:
        key = sender_of(request), request.mission_type
        download = self._downloads.get(key)
        if download is None or self._host.now - download.used_at > self.timeout_s:
            return super()._requested_item(request)
        self._downloads[key] = download._replace(used_at=self._host.now)
        return download.items[request.seq] if request.seq < len(download.items) else None

    def _on_ack(self, ack: m.MissionAck, channel: Channel) -> None:
        self._downloads.pop((sender_of(ack), ack.mission_type), None)
        super()._on_ack(ack, channel)

    def _on_count(self, message: m.MissionCount, channel: Channel) -> None:
        self._downloads.pop((sender_of(message), message.mission_type), None)
        super()._on_count(message, channel)


def _result_of(verdict: object) -> int:
    """Convert the return value of the program's function to a MAV_MISSION_RESULT."""
    if verdict is False:
        return MavMissionResult.DENIED
    if isinstance(verdict, int) and not isinstance(verdict, bool):
        if not 0 <= verdict <= 255:
            raise TypeError(f"the function returned {verdict}, which is no MAV_MISSION_RESULT")
        return int(verdict)
    return MavMissionResult.ACCEPTED


def _type_of(kind: str) -> int:
    if kind not in _TYPES_BY_KIND:
        raise InvalidArgument(f"kind = {kind!r} is not allowed: it must be 'mission', 'fence' or 'rally'")
    return _TYPES_BY_KIND[kind]
