"""Snapshots behave like frozen dataclasses."""

from __future__ import annotations

import copy
import inspect
import pickle

import pytest

from aerokit._internal.values import Snapshot


class Point(Snapshot):
    """Two numbers."""

    x: float
    y: float = 2.0


class Timed(Snapshot):
    """A value with a time."""

    at: float


class TimedText(Timed):
    """A subclass with another field."""

    text: str
    loudness: float = 1.0


class SameFields(TimedText):
    """A subclass without fields."""


class Positive(Snapshot):
    """A number above zero."""

    number: int

    def _check(self) -> None:
        if self.number <= 0:
            raise ValueError(self.number)


def test_snapshot_constructor_arguments() -> None:
    assert (Point(1).x, Point(1).y, Point(y=5, x=4).to_dict()) == (1, 2.0, {"x": 4, "y": 5})
    with pytest.raises(TypeError):
        Point()  # type: ignore[call-arg]


def test_snapshot_signature_shows_fields() -> None:
    class Extended(TimedText):
        """A class without instances."""

        of: str = "it"

    shown = "(at, text, loudness=1.0, of='it')"
    assert str(inspect.signature(Extended)) == shown
    Extended(1.0, "a")
    assert str(inspect.signature(Extended)) == shown
    assert str(inspect.signature(SameFields)) == "(at, text, loudness=1.0)"
    assert str(inspect.signature(Snapshot)) == "()"

    class OwnInit(Extended):
        """A class with a default."""

        def __init__(self, text: str) -> None:
            super().__init__(0.0, text)

    assert str(inspect.signature(OwnInit)) == "(text: 'str') -> 'None'"
    assert OwnInit("a").text == "a"


def test_snapshot_is_immutable() -> None:
    point = Point(1)
    with pytest.raises(AttributeError, match=r"Point is immutable: use replace\(x=…\)"):
        setattr(point, "x", 3)  # noqa: B010
    with pytest.raises(AttributeError):
        setattr(point, "z", 3)  # noqa: B010
    with pytest.raises(AttributeError):
        delattr(point, "x")
    assert not hasattr(point, "__dict__")


def test_snapshot_equality_hash_and_copies() -> None:
    assert Point(1) == Point(1, 2.0) != Point(2)
    assert Point(1) != (1, 2.0)
    assert len({Point(1), Point(1), Point(2)}) == 2
    assert Point(1).replace(y=3) == Point(1, 3)
    assert pickle.loads(pickle.dumps(Point(1))) == copy.deepcopy(Point(1)) == Point(1)


def test_snapshot_repr_and_matching() -> None:
    assert repr(Point(0.1 + 0.2, 3)) == "Point(x=0.3, y=3)"
    match Point(1, 7):
        case Point(x, y):
            assert (x, y) == (1, 7)


def test_snapshot_base_fields_come_first() -> None:
    text = TimedText(1.5, "ping")
    assert text.to_dict() == {"at": 1.5, "text": "ping", "loudness": 1.0}
    assert (Timed(1.5) == text, text == TimedText(1.5, "ping", 1.0)) == (False, True)
    assert not hasattr(text, "__dict__")


def test_snapshot_subclass_without_own_fields() -> None:
    assert repr(SameFields(1, "ping")) == "SameFields(at=1, text='ping', loudness=1.0)"
    assert SameFields(1, "ping") != TimedText(1, "ping")


def test_snapshot_check_rejects_invalid_fields() -> None:
    assert Positive(1).number == 1
    with pytest.raises(ValueError, match="-1"):
        Positive(-1)
    with pytest.raises(ValueError, match="0"):
        Positive(1).replace(number=0)
