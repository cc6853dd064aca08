"""Opening several links: duplicates are refused, and a failed link is reported."""

from __future__ import annotations

import logging
from functools import partial

import anyio
import pytest
from several_harness import EventLog

from aerokit import events
from aerokit.connection.opening import open_connection
from aerokit.errors import InvalidArgument, LinkOpenError
from aerokit.events import LinkState
from aerokit.testing import VIRTUAL_BACKEND
from aerokit.transport import Link, MemoryLink, MultiLink, memory_link_pair

pytestmark = pytest.mark.anyio


@pytest.fixture
def anyio_backend() -> tuple[str, dict[str, object]]:
    return VIRTUAL_BACKEND


@pytest.mark.parametrize(
    ("one", "again"),
    [
        ("udpin:127.0.0.1:14550", "udp://127.0.0.1:14550"),
        ("tcp:127.0.0.1:1", "tcp:127.0.0.1:1?timeout=3"),
        ("udpout:127.0.0.1:14550", "udpout:127.0.0.1:14550?costly=1"),
        ("/dev/ttyUSB0,57600", "serial:///dev/ttyUSB0:115200"),
        ("pty:/tmp/aerokit", "pty:/tmp/aerokit"),
        ("zenoh://north/alpha", "zenoh://north/alpha"),
    ],
)
async def test_duplicate_address_is_refused_before_opening(one: str, again: str) -> None:
    near, far = memory_link_pair()
    with pytest.raises(InvalidArgument, match=r"address = .* is not allowed: .* is listed twice") as caught:
        async with open_connection([near, one, again]):
            pass
    assert repr(again) in str(caught.value)
    async with open_connection(near):
        far.close()


@pytest.mark.parametrize("has_link_object", [True, False])
async def test_peers_that_filter_no_sender_are_refused(has_link_object: bool) -> None:
    near, _ = memory_link_pair()
    addresses: list[str | Link] = ["udpout:127.0.0.1:1", "tcp:127.0.0.1:1"]
    if has_link_object:
        addresses = ["udpin:127.0.0.1:0", near]
    with pytest.raises(InvalidArgument, match="peers = … is not allowed"):
        async with open_connection(addresses, peers="127.0.0.1"):
            pass


async def test_duplicate_link_object_is_refused() -> None:
    near, far = memory_link_pair()
    with pytest.raises(InvalidArgument, match="is listed twice"):
        async with open_connection([near, near]):
            pass
    async with open_connection(near):
        far.close()


async def test_addresses_that_open_something_new_may_repeat() -> None:
    async with open_connection(["udpin:127.0.0.1:0", "udpin:127.0.0.1:0", "tcpin:127.0.0.1:0"]) as connection:
        assert isinstance(connection.link, MultiLink)
        assert [connection.link.is_available(link) for link in range(3)] == [True, True, True]


class OpensLater(MemoryLink):
    """Cannot be opened for the first few times."""

    def __init__(self, failures: int) -> None:
        super().__init__("memory:away")
        self.failures = failures

    async def _connect(self) -> None:
        self.failures -= 1
        if self.failures >= 0:
            raise OSError(111, "refused")
        await super()._connect()


@pytest.mark.parametrize("failures", [1, 4])
async def test_failed_member_link_is_reported_once(failures: int, caplog: pytest.LogCaptureFixture) -> None:
    near, _far = memory_link_pair()
    both: list[Link] = [near, OpensLater(failures)]
    together = MultiLink([partial(both.__getitem__, index) for index in range(2)])
    with caplog.at_level(logging.WARNING, "aerokit"):
        async with open_connection(together) as connection:
            news = EventLog(connection, events.MemberLinkOpenFailed, events.MemberLinkStateChanged)
            await anyio.sleep(30)
            reported = [event for event in news.all if isinstance(event, events.MemberLinkOpenFailed)]
            assert [event.link for event in reported] == ["memory:away"] * (failures > 1)
            assert all(isinstance(event.error, LinkOpenError) for event in reported)
            last = news.all[-1]
            assert isinstance(last, events.MemberLinkStateChanged)
            assert (last.link, last.after) == ("memory:away", LinkState.CONNECTED)
    warnings = [record.getMessage() for record in caplog.records if "memory:away" in record.getMessage()]
    assert len(warnings) == 1
    assert "refused" in warnings[0]
