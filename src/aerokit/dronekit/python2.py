"""``Python2Mapping``: what mappings had in Python 2, for programs from those days."""

from __future__ import annotations

from collections.abc import ItemsView, Iterator, KeysView, Mapping, ValuesView
from typing import TypeVar

__all__ = ["Python2Mapping"]

ValueT = TypeVar("ValueT")


class Python2Mapping(Mapping[str, ValueT]):
    """Adds those methods to what a mapping has in Python 3."""

    def has_key(self, name: object) -> bool:
        """As ``name in mapping``."""
        return name in self

    def iteritems(self) -> Iterator[tuple[str, ValueT]]:
        """As ``iter(items())``."""
        return iter(self.items())

    def iterkeys(self) -> Iterator[str]:
        """As ``iter(keys())``."""
        return iter(self.keys())

    def itervalues(self) -> Iterator[ValueT]:
        """As ``iter(values())``."""
        return iter(self.values())

    def viewitems(self) -> ItemsView[str, ValueT]:
        """As ``items()``."""
        return self.items()

    def viewkeys(self) -> KeysView[str]:
        """As ``keys()``."""
        return self.keys()

    def viewvalues(self) -> ValuesView[ValueT]:
        """As ``values()``."""
        return self.values()
