"""Snapshots: what a frozen dataclass promises, kept."""

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


class Seen(Snapshot):
    """Something at a time."""

    at: float


class Heard(Seen):
    """More of it."""

    text: str
    loudness: float = 1.0


class HeardAgain(Heard):
    """The same with another name."""


class Positive(Snapshot):
    """A number above zero."""

    number: int

    def _check(self) -> None:
        if self.number <= 0:
            raise ValueError(self.number)


def test_fields_by_place_by_name_and_by_default() -> None:
    assert (Point(1).x, Point(1).y, Point(y=5, x=4).to_dict()) == (1, 2.0, {"x": 4, "y": 5})
    with pytest.raises(TypeError):
        Point()  # type: ignore[call-arg]


def test_what_is_shown_of_a_class_are_its_fields_before_and_after_the_first_value() -> None:
    class Late(Heard):
        """Of which none was made."""

        of: str = "it"

    shown = "(at, text, loudness=1.0, of='it')"
    assert str(inspect.signature(Late)) == shown
    Late(1.0, "a")
    assert str(inspect.signature(Late)) == shown
    assert str(inspect.signature(HeardAgain)) == "(at, text, loudness=1.0)"
    assert str(inspect.signature(Snapshot)) == "()"

    class OwnWay(Late):
        """Made of something else."""

        def __init__(self, text: str) -> None:
            super().__init__(0.0, text)

    assert str(inspect.signature(OwnWay)) == "(text: 'str') -> 'None'"
    assert OwnWay("a").text == "a"


def test_it_cannot_be_changed_and_has_no_other_attributes() -> None:
    point = Point(1)
    with pytest.raises(AttributeError, match=r"Point is immutable: use replace\(x=…\)"):
        setattr(point, "x", 3)  # noqa: B010
    with pytest.raises(AttributeError):
        setattr(point, "z", 3)  # noqa: B010
    with pytest.raises(AttributeError):
        delattr(point, "x")
    assert not hasattr(point, "__dict__")


def test_equality_hash_and_copies() -> None:
    assert Point(1) == Point(1, 2.0) != Point(2)
    assert Point(1) != (1, 2.0)
    assert len({Point(1), Point(1), Point(2)}) == 2
    assert Point(1).replace(y=3) == Point(1, 3)
    assert pickle.loads(pickle.dumps(Point(1))) == copy.deepcopy(Point(1)) == Point(1)


def test_repr_and_matching() -> None:
    assert repr(Point(0.1 + 0.2, 3)) == "Point(x=0.3, y=3)"
    match Point(1, 7):
        case Point(x, y):
            assert (x, y) == (1, 7)


def test_fields_of_the_base_class_come_first() -> None:
    heard = Heard(1.5, "ping")
    assert heard.to_dict() == {"at": 1.5, "text": "ping", "loudness": 1.0}
    assert (Seen(1.5) == heard, heard == Heard(1.5, "ping", 1.0)) == (False, True)
    assert not hasattr(heard, "__dict__")


def test_a_subclass_without_fields_of_its_own_is_made_the_same_way() -> None:
    assert repr(HeardAgain(1, "ping")) == "HeardAgain(at=1, text='ping', loudness=1.0)"
    assert HeardAgain(1, "ping") != Heard(1, "ping")


def test_a_check_refuses_nonsense() -> None:
    assert Positive(1).number == 1
    with pytest.raises(ValueError, match="-1"):
        Positive(-1)
    with pytest.raises(ValueError, match="0"):
        Positive(1).replace(number=0)
