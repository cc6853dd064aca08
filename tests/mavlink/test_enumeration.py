"""The fast way to make enums gives the same classes as the usual one."""

from __future__ import annotations

import pickle
from enum import IntFlag
from typing import Any

import pytest
from for_each import for_each

from aerokit import enums
from aerokit.mavlink.message import make_enum

NAMES = [name for name in dir(enums) if isinstance(getattr(enums, name), type)]


@for_each("name", NAMES)
def test_both_enum_constructions_are_equal(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    quick: Any = getattr(enums, name)
    members = [(name, int(value)) for name, value in quick.__members__.items()]
    monkeypatch.setattr("aerokit.mavlink.message._simple_enum", None)
    usual: Any = make_enum(quick.__module__, name, issubclass(quick, IntFlag), quick.__doc__, members)
    assert [(*pair,) for pair in usual.__members__.items()] == [(*pair,) for pair in quick.__members__.items()]
    assert [repr(member) for member in usual] == [repr(member) for member in quick]
    assert (usual.__doc__, usual.__mro__[1:]) == (quick.__doc__, quick.__mro__[1:])
    for member in quick:
        assert pickle.loads(pickle.dumps(member)) is member
        assert (quick(member.value), hash(member), f"{member}") == (member, hash(int(member)), str(int(member)))


def test_unnamed_flag_bits_are_kept() -> None:
    flags = enums.MavModeFlag(128 | 1 << 20)
    assert (int(flags), flags & enums.MavModeFlag.SAFETY_ARMED) == (
        128 | 1 << 20,
        enums.MavModeFlag.SAFETY_ARMED,
    )
    with pytest.raises(ValueError, match="is not a valid MavResult"):
        enums.MavResult(99)


def test_flag_combinations_are_not_cached() -> None:
    known = len(enums.MavProtocolCapability._value2member_map_)
    for value in range(3000):
        assert int(enums.MavProtocolCapability(value)) == value
    assert len(enums.MavProtocolCapability._value2member_map_) == known
    mix = enums.MavProtocolCapability.FTP | enums.MavProtocolCapability.MAVLINK2
    assert (mix, {mix: 1}[enums.MavProtocolCapability(int(mix))]) == (int(mix), 1)
    assert len(enums.MavProtocolCapability._value2member_map_) == known
