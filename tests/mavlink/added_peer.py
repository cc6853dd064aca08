"""Modules made by pymavlink's generator for the messages that `additions` adds or extends."""

from __future__ import annotations

import sys
from contextlib import redirect_stdout
from functools import cache
from importlib.util import module_from_spec, spec_from_file_location
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from xml.sax.saxutils import quoteattr

from pymavlink.generator import mavgen

from aerokit.mavlink.definitions import FieldDefinition, MessageDefinition
from aerokit.mavlink.generator import definitions, read_additions

__all__ = ["NAMED", "added_module"]

NAMED = {(message.id, f.name) for d in read_additions() for message in d.messages for f in message.fields}
"""Message id and name of each field in the additions."""


@cache
def added_module(version: int, known: frozenset[tuple[int, str]]) -> Any:
    """Generate pymavlink's module for all messages with fields that are not ``known``."""
    messages = [m for m in definitions()[0] if any((m.id, f.name) not in known for f in m.fields)]
    name = f"aerokit_additions_v{version}0"
    with TemporaryDirectory() as folder:
        source, target = Path(folder, f"{name}.xml"), Path(folder, f"{name}.py")
        source.write_text("<mavlink><messages>" + "".join(map(_xml, messages)) + "</messages></mavlink>")
        with redirect_stdout(StringIO()):
            mavgen.mavgen(mavgen.Opts(str(target), f"{version}.0", "Python3", False), [str(source)])
        spec = spec_from_file_location(name, target)
        assert spec is not None
        assert spec.loader is not None
        module = sys.modules[name] = module_from_spec(spec)
        spec.loader.exec_module(module)
    return module


def _xml(message: MessageDefinition) -> str:
    base = "".join(_field(f) for f in message.fields if not f.extension)
    extensions = "".join(_field(f) for f in message.fields if f.extension)
    return f'<message id="{message.id}" name="{message.name}">{base}<extensions/>{extensions}</message>'


def _field(f: FieldDefinition) -> str:
    brackets = f"[{f.array_length}]" if f.array_length else ""
    return f'<field type="{f.type}{brackets}" name="{f.name}" units={quoteattr(f.units)}/>'
