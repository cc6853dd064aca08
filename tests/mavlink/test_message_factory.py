"""pymavlink's message factory with a send function supplied by the program."""

from __future__ import annotations

from typing import Any

import pytest

from aerokit.errors import InvalidArgument
from aerokit.mavlink import Message, messages
from aerokit.mavlink.message_factory import MessageFactory
from aerokit.mavlink.pymavlink import from_pymavlink

TARGET = 7


def test_message_factory_passes_messages_to_program() -> None:
    sent: list[Message] = []
    factory: Any = MessageFactory(lambda message: sent.append(from_pymavlink(message, TARGET)), 255, 190)
    factory.param_set_send(0, 1, "RTL_ALT", 30, 9)
    assert sent == [messages.ParamSet(TARGET, 1, "RTL_ALT", 30.0, 9)]
    assert (factory.seq, factory.total_packets_sent) == (1, 1)
    assert (factory.srcSystem, factory.srcComponent) == (255, 190)


def test_message_factory_error_is_raised_and_not_counted() -> None:
    factory: Any = MessageFactory(from_pymavlink, 255, 0)
    with pytest.raises(InvalidArgument, match="param_type"):
        factory.param_set_send(1, 1, b"RTL_ALT", 30, 900)
    with pytest.raises(InvalidArgument, match="a text field must be str or bytes"):
        factory.param_set_send(1, 1, 5, 30, 9)
    assert (factory.seq, factory.total_packets_sent) == (0, 0)
