"""Hostile camera definition files: parsing stays fast and correct."""

from __future__ import annotations

import lzma
from itertools import pairwise

import pytest

from aerokit.errors import FileFormatError, InvalidArgument
from aerokit.parameters import parse_definition
from aerokit.parameters.definition import MAX_DEFINITION_SIZE, MAX_ELEMENTS


def file_of(settings: str) -> bytes:
    return f"<mavlinkcamera><parameters>{settings}</parameters></mavlinkcamera>".encode()


def test_definition_rejects_decompression_bomb() -> None:
    packed = lzma.compress(file_of("<!--" + "x" * MAX_DEFINITION_SIZE + "-->"))
    assert len(packed) < 10_000
    with pytest.raises(FileFormatError, match="more than 1024 kB"):
        parse_definition(packed)


@pytest.mark.parametrize("element", ["<a/>", '<parameter name="A" type="bool"/>'])
def test_definition_rejects_too_many_elements(element: str) -> None:
    with pytest.raises(FileFormatError, match=f"more than {MAX_ELEMENTS} elements"):
        parse_definition(file_of(element * MAX_ELEMENTS))


def test_options_of_several_dependencies_are_fast() -> None:
    """4,000 options under each of two dependencies: comparing all pairs took minutes."""
    allowed = "".join(f'<roption name="o{number}" value="{number}"/>' for number in range(4000))

    def ruler(name: str) -> str:
        return (
            f'<parameter name="{name}" type="int32"><options><option name="on" value="1"><parameterranges>'
            f'<parameterrange parameter="A">{allowed}</parameterrange></parameterranges></option></options></parameter>'
        )

    definition = parse_definition(file_of('<parameter name="A" type="int32"/>' + ruler("B") + ruler("C")))
    found = definition.options("A", {"B": 1, "C": 1})
    assert len(found) == 4000
    assert all(one.value < other.value for one, other in pairwise(found))  # type: ignore[operator]
    assert definition.checked("A", 17, {"B": 1, "C": 1}) == 17


@pytest.mark.parametrize("bound", ["0x" + "f" * 400, "1e400", "nan", "inf"])
@pytest.mark.parametrize("which", ["min", "max", "step"])
def test_definition_ignores_infinite_bounds(which: str, bound: str) -> None:
    definition = parse_definition(file_of(f'<parameter name="A" type="int32" {which}="{bound}"/>'))
    assert definition.checked("A", 5, {}) == 5
    assert definition.settings["A"].minimum is definition.settings["A"].maximum is None


def test_definition_ignores_invalid_names() -> None:
    definition = parse_definition(
        file_of(
            f'<parameter name="{"N" * 17}" type="bool"/><parameter name="é" type="bool"/>'
            f'<parameter name="A" type="bool"><updates><update>{"N" * 17}</update>'
            "<update>B</update></updates></parameter>"
        )
    )
    assert list(definition.settings) == ["A"]
    assert definition.settings["A"].updates == ("B",)


def test_options_equal_as_stored_are_kept() -> None:
    both = '<roption name="a" value="0.1"/><roption name="b" value="0.2"/>'
    one = '<roption name="a" value="0.10000000149"/>'
    dependencies = "".join(
        f'<parameter name="{name}" type="int8"><options><option name="on" value="1"><parameterranges><parameterrange'
        f' parameter="A">{options}</parameterrange></parameterranges></option></options></parameter>'
        for name, options in (("B", both), ("C", one))
    )
    definition = parse_definition(file_of('<parameter name="A" type="float"/>' + dependencies))
    assert [option.name for option in definition.options("A", {"B": 1, "C": 1})] == ["a"]
    with pytest.raises(InvalidArgument):
        definition.checked("A", 0.2, {"B": 1, "C": 1})
