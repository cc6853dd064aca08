"""What a component tells of itself in files: COMPONENT_METADATA names the first, and that one the others."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from aerokit.errors import CommandRejected, FileFormatError, NotSupported, OperationTimeout
from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import CompMetadataType
from aerokit.vehicle.components.remote_file import WEB
from aerokit.whole_file import unpacked

if TYPE_CHECKING:
    from aerokit.vehicle.components.component import Component

__all__ = ["KINDS", "read_metadata"]

KINDS = {each.name.lower(): int(each) for each in CompMetadataType}
"""Kinds of files: ``"general"``, ``"parameter"``, ``"commands"``, ``"peripherals"``, ``"events"``, ``"actuators"``."""


async def read_metadata(component: Component, kind: str, timeout: float) -> dict[str, Any]:
    """Fetch the file of this kind by MAVFTP; see :meth:`Component.metadata`."""
    general = await _read(component, await _general_uri(component, timeout))
    if kind == "general":
        return general
    for each in _listed(general):
        if each.get("type") == KINDS[kind] and isinstance(each.get("uri"), str):
            return await _read(component, each["uri"])
    raise NotSupported(f"component {component.component_id} has no metadata of its {kind}")


async def _general_uri(component: Component, timeout: float) -> str:
    """Where its first file is, by COMPONENT_METADATA, or COMPONENT_INFORMATION of older firmware."""
    try:
        return (await component.request(m.ComponentMetadata, timeout=timeout)).uri
    except CommandRejected:
        pass
    except OperationTimeout as error:
        raise NotSupported(f"component {component.component_id} tells of no metadata: {error}") from None
    try:
        return (await component.request(m.ComponentInformation, timeout=timeout)).general_metadata_uri
    except (CommandRejected, OperationTimeout) as error:
        raise NotSupported(f"component {component.component_id} tells of no metadata: {error}") from None


def _listed(general: dict[str, Any]) -> list[dict[str, Any]]:
    listed = general.get("metadataTypes")
    return [each for each in listed if isinstance(each, dict)] if isinstance(listed, list) else []


async def _read(component: Component, uri: str) -> dict[str, Any]:
    if uri.lower().startswith(WEB):
        raise NotSupported(f"{uri} is not on the vehicle: fetch it by another program")
    data = unpacked(await component.fetch(uri), uri)
    try:
        content = json.loads(data.decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise FileFormatError(f"{uri}: no JSON: {error}") from None
    if not isinstance(content, dict):
        raise FileFormatError(f"{uri}: its outermost value is no object")
    return content
