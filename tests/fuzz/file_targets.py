"""Fuzz targets of files: plans, parameter files and packs, metadata, dialects."""

from __future__ import annotations

import math
import tempfile
from contextlib import suppress
from pathlib import Path

from target import Target

from aerokit.errors import FileFormatError, InvalidArgument, RemoteProtocolError
from aerokit.mavlink import Dialect
from aerokit.missions import Mission
from aerokit.missions.plan_file import format_plan, parse_plan
from aerokit.missions.waypoint_file import format_waypoints, parse_waypoints
from aerokit.missions.wire import unpack_items
from aerokit.parameters import (
    pack_parameters,
    parse_definition,
    parse_metadata,
    parse_parameter_file,
    unpack_parameters,
)
from aerokit.parameters.files import parameter_file_text
from aerokit.parameters.pack import HEADER, read_header
from aerokit.parameters.parameter import setting_bytes, setting_value

__all__ = ["FILE_TARGETS"]


def fuzz_plan(data: bytes) -> None:
    """A plan that can be read is written and read again unchanged, also with other items."""
    try:
        plan = parse_plan(data.decode(errors="surrogateescape"))
    except FileFormatError:
        return
    for variant in (plan, plan.replace(mission=Mission(), source=plan.source), plan.replace(source="")):
        try:
            text = format_plan(variant)
        except InvalidArgument:
            continue
        assert parse_plan(text) == variant


def fuzz_waypoints(data: bytes) -> None:
    """A waypoint file that can be read is written and read again unchanged."""
    try:
        mission = parse_waypoints(data.decode(errors="surrogateescape"))
        text = format_waypoints(mission)
    except (FileFormatError, InvalidArgument):
        return
    again = parse_waypoints(text)
    assert len(again.items) == len(mission.items)


def fuzz_parameter_file(data: bytes) -> None:
    """A parameter file that can be read is written in each format, and read again with the same numbers."""
    try:
        file = parse_parameter_file(data.decode(errors="surrogateescape"))
    except FileFormatError:
        return
    for form in ("missionplanner", "mavproxy", "qgroundcontrol"):
        try:
            text = parameter_file_text(file, form)
        except InvalidArgument:
            continue
        again = parse_parameter_file(text)
        assert again.keys() == file.keys()
        assert all(math.isclose(again[name], file[name], rel_tol=1e-6, abs_tol=1e-37) for name in file)


def fuzz_parameter_pack(data: bytes) -> None:
    """Each reader of packed files returns a table or raises FileFormatError."""
    with suppress(RemoteProtocolError):
        unpack_items(data)
    try:
        table = unpack_parameters(data)
    except RemoteProtocolError:
        return
    try:
        packed = pack_parameters(table.values())
    except InvalidArgument:  # NaN
        return
    magic, count, length = read_header(packed)
    assert length == len(packed)
    assert unpack_parameters(HEADER.pack(magic, count, count) + packed[HEADER.size :]).keys() == table.keys()


def fuzz_metadata(data: bytes) -> None:
    """All metadata that can be read accepts any number."""
    try:
        metadata = parse_metadata(data)
    except FileFormatError:
        return
    for name, known in metadata.items():
        for value in (0, 5, -1.5, math.inf, math.nan, 1e300, *known.values):
            assert isinstance(known.describe(value), str)
            known.problem(value)
        assert name == known.name


def fuzz_camera_definition(data: bytes) -> None:
    """Each setting of any definition accepts a value or raises, for any options of the others."""
    try:
        camera = parse_definition(data)
    except FileFormatError:
        return
    values = {name: setting.options[-1].value for name, setting in camera.settings.items() if setting.options}
    for values_read in ({}, values):
        for name, setting in camera.localized("de").settings.items():
            assert name not in camera.dependencies(name)
            for value in (
                0,
                1.5,
                "A",
                b"A",
                math.nan,
                1 << 70,
                *(one.value for one in camera.options(name, values_read)),
            ):
                with suppress(InvalidArgument):
                    sent = camera.checked(name, value, values_read)
                    assert setting_value(setting_bytes(sent, setting.wire_type), setting.wire_type) == sent


def fuzz_dialect(data: bytes) -> None:
    """A dialect whose messages can be created, sent and read, or our error."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "fuzzed.xml"
        path.write_bytes(data)
        try:
            dialect = Dialect.from_xml(path)
        except InvalidArgument:
            return
    for message_class in dialect:
        message = message_class.decode(bytes(3))
        assert message_class.decode(message.encode()) == message


FILE_TARGETS = (
    Target("plan", fuzz_plan, 16384),
    Target("waypoints", fuzz_waypoints, 4096),
    Target("parameter_file", fuzz_parameter_file, 4096),
    Target("parameter_pack", fuzz_parameter_pack, 2048),
    Target("metadata", fuzz_metadata, 8192),
    Target("camera_definition", fuzz_camera_definition, 8192),
    Target("dialect", fuzz_dialect, 4096),
)
