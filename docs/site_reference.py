"""Generates the reference pages, which mkdocstrings fills."""

from __future__ import annotations

import enum as enum_kinds
import importlib
import inspect
import re
from collections.abc import Iterator
from dataclasses import dataclass
from types import ModuleType

VEHICLE = "aerokit.vehicle"


@dataclass(frozen=True)
class Page:
    """One page of the reference, with the public names of its modules."""

    name: str
    title: str
    about: str
    modules: tuple[str, ...]


REFERENCE_PAGES = (
    Page("aerokit", "aerokit", "Connecting, and the most common names", ("aerokit",)),
    Page("vehicle", "aerokit.vehicle: Vehicle", "State, actions, and access to its parts",
         (f"{VEHICLE}.vehicle", f"{VEHICLE}.connect")),
    Page("fleets", "aerokit.fleets: Fleet", "Many vehicles together",
         tuple(f"aerokit.fleets.{name}" for name in (
             "fleet", "members", "policy", "events", "formation", "separation", "paths", "show", "show_flight"))),
    Page("cells", "Cells and subscriptions", "Values with their age; streams of messages and events",
         ("aerokit.connection.cells", "aerokit.connection.bus")),
    Page("state", "Values of the state", "The types of state cells",
         (f"{VEHICLE}.state.movement", f"{VEHICLE}.state.condition", f"{VEHICLE}.state.equipment",
          f"{VEHICLE}.state.status_text")),
    Page("guided", "Set-point streams, posted orders", "`vehicle.guided`, `vehicle.posted`",
         (f"{VEHICLE}.commanding.guided", f"{VEHICLE}.commanding.setpoints", f"{VEHICLE}.commanding.posted")),
    Page("missions", "Missions, fences, rally points", "`vehicle.mission`, `.fence`, `.rally`, and `aerokit.missions`",
         (f"{VEHICLE}.missions.mission", f"{VEHICLE}.missions.plans", "aerokit.missions")),
    Page("parameters", "Parameters", "`vehicle.parameters`, and `aerokit.parameters`",
         (f"{VEHICLE}.parameters.parameters", f"{VEHICLE}.parameters.writing", f"{VEHICLE}.parameters.transaction",
          "aerokit.parameters")),
    Page("files", "Files and logs", "`vehicle.files`, `vehicle.logs`",
         (f"{VEHICLE}.files.files", f"{VEHICLE}.files.logs")),
    Page("camera", "Cameras", "`vehicle.camera`, `vehicle.camera_at`",
         (f"{VEHICLE}.camera.cameras", f"{VEHICLE}.camera.values", f"{VEHICLE}.camera.capture", "aerokit.video")),
    Page("gimbal", "Gimbals", "`vehicle.gimbal`, `vehicle.gimbals`",
         (f"{VEHICLE}.gimbal.gimbal", f"{VEHICLE}.gimbal.control", f"{VEHICLE}.gimbal.rates",
          f"{VEHICLE}.gimbal.device")),
    Page("components", "Components", "`vehicle.component(id)`",
         (f"{VEHICLE}.components.component", f"{VEHICLE}.components.settings")),
    Page("errors", "aerokit.errors", "All exceptions", ("aerokit.errors",)),
    Page("events", "aerokit.events", "All events", ("aerokit.events",)),
    Page("sync", "aerokit.sync", "The blocking API", ("aerokit.sync",)),
    Page("dronekit", "aerokit.dronekit", "The classic API", ("aerokit.dronekit",)),
    Page("sim", "aerokit.sim", "Simulated vehicles", ("aerokit.sim", "aerokit.sim.kinds", "aerokit.testing.picture")),
    Page("testing", "aerokit.testing", "Tests of your program", ("aerokit.testing",)),
    Page("transport", "aerokit.transport", "Links", ("aerokit.transport",)),
    Page("hub", "aerokit.hub", "Links joined into one network", ("aerokit.hub",)),
    Page("mavlink", "aerokit.mavlink", "Frames, messages, signing", ("aerokit.mavlink", "aerokit.mavlink.pymavlink")),
    Page("protocols", "aerokit.protocols", "MAVLink's services without I/O",
         tuple(f"aerokit.protocols.{name}" for name in (
             "exchange", "command", "parameter_list", "parameter_requests", "extended_parameters", "missions",
             "mission_download", "mission_upload", "ftp", "ftp_transfer", "logs"))),
    Page("autopilots", "aerokit.autopilots", "What differs between firmwares", ("aerokit.autopilots",)),
    Page("convert", "aerokit.logs.convert", "Logs in other formats", ("aerokit.logs.convert",)),
    Page("flights", "aerokit.logs.flights", "Flights read from logs", ("aerokit.logs.flights",)),
    Page("report", "aerokit.logs.report", "A flight as one HTML file", ("aerokit.logs.report",)),
    Page("foxglove", "aerokit.apps.foxglove", "Vehicles live in Foxglove", ("aerokit.apps.foxglove",)),
    Page("network", "aerokit.apps.network", "State for other computers and languages", ("aerokit.apps.network",)),
    Page("serve", "aerokit.apps.serve", "Web page and HTTP API", ("aerokit.apps.serve",)),
    Page("monitor", "aerokit.apps.monitor", "Vehicles in the terminal", ("aerokit.apps.monitor.app",)),
)  # fmt: skip
GENERATED_PAGES = {
    "messages": "Every message of the standard dialect",
    "enums": "Every enum of the standard dialect",
    "cli": "Every option of the command line",
}
TITLES = {
    "messages": "aerokit.messages",
    "enums": "aerokit.enums",
    "cli": "aerokit.apps.cli: the command line",
}


def reference_pages() -> Iterator[tuple[str, str]]:
    """Yield path on the site and text of each page."""
    yield "reference/index.md", _index()
    pages = _pages_of_names()
    for page in REFERENCE_PAGES:
        yield f"reference/{page.name}.md", _page(page, pages)
    yield "reference/messages.md", _messages()
    yield "reference/enums.md", _enums()
    yield "reference/cli.md", _command_line()


def _pages_of_names() -> dict[str, Page]:
    """Map each object to its page: the first page with its module, and the page of `aerokit` last."""
    pages: dict[str, Page] = {}
    for page in (*REFERENCE_PAGES[1:], REFERENCE_PAGES[0]):
        for module_name in page.modules:
            for full_name in _full_names(importlib.import_module(module_name)):
                pages.setdefault(full_name, page)
    return pages


def _index() -> str:
    rows = [(page.name, page.title, page.about) for page in REFERENCE_PAGES]
    rows += [(name, TITLES[name], about) for name, about in GENERATED_PAGES.items()]
    table = "".join(f"| [{title}]({name}.md) | {about} |\n" for name, title, about in rows)
    text = (
        "Every public name, with inherited members. Modules that are on none of these pages are internal and may"
        " change with any version."
    )
    return f"# Reference\n\n{text}\n\n| | |\n|---|---|\n{table}"


def _page(page: Page, pages: dict[str, Page]) -> str:
    """Return a page: its objects, and links to exported objects on other pages."""
    text = [f"# {page.title}\n"]
    for name in page.modules:
        module = importlib.import_module(name)
        names = list(dict.fromkeys(_full_names(module)))
        if len(page.modules) > 1:
            text.append(f"## {name}\n")
        if hasattr(module, "__path__"):  # packages have a description
            text.append(f"{inspect.getdoc(module)}\n")
        elsewhere = [f"[`{name.rpartition('.')[2]}`][{name}]" for name in names if pages[name] is not page]
        if elsewhere:
            text.append(f"On other pages: {', '.join(elsewhere)}.\n")
        level = 3 if len(page.modules) > 1 else 2
        here = [name for name in names if pages[name] is page and name not in _listed(text)]
        text += [f"::: {name}\n    options:\n      heading_level: {level}\n" for name in here]
    return "\n".join(text)


def _listed(text: list[str]) -> set[str]:
    return {line[4:].partition("\n")[0] for line in text if line.startswith("::: ")}


def _full_names(module: ModuleType) -> Iterator[str]:
    """Yield the full name of each public object: where it is defined, or where it is exported if it has no module."""
    for name in getattr(module, "__all__", ()):
        item = getattr(module, name)
        if inspect.ismodule(item):
            continue
        home, own_name = str(getattr(item, "__module__", "")), getattr(item, "__name__", "")
        is_ours = home.partition(".")[0] == "aerokit"
        if is_ours and getattr(importlib.import_module(home), own_name or name, None) is item:
            yield f"{home}.{own_name or name}"
        elif is_ours or own_name != name:  # skip names of other libraries
            yield f"{module.__name__}.{name}"


# ------------------------------------------------------------------------------------ generated code


def _messages() -> str:
    from aerokit import messages
    from aerokit.mavlink.message import Message

    parts = [
        "# aerokit.messages\n",
        "`from aerokit import messages`; `help(messages.Attitude)` has fields with types and units.\n",
    ]
    for name in sorted(messages.__all__):
        message = getattr(messages, name)
        if inspect.isclass(message) and issubclass(message, Message):
            fields = ", ".join(f"`{field.name}`" for field in message.FIELDS)
            parts.append(f"{_item(name, message)} {fields}\n")
    return "\n".join(parts)


def _enums() -> str:
    from aerokit import enums

    parts = [
        "# aerokit.enums\n",
        "`from aerokit import enums`; `help(enums.MavCmd)` describes each member.\n",
    ]
    for name in sorted(enums.__all__):
        enum: type[enum_kinds.IntEnum] = getattr(enums, name)
        if inspect.isclass(enum):
            members = ", ".join(f"`{member}` {int(value)}" for member, value in enum.__members__.items())
            parts.append(f"{_item(name, enum)} {members}\n")
    return "\n".join(parts)


def _item(name: str, item: type) -> str:
    """Return a paragraph with an anchor and the first sentence of the standard's description."""
    text = " ".join((inspect.getdoc(item) or "").split())
    sentence = re.split(r"(?<!e\.g)(?<!i\.e)\. ", text)[0].rstrip(".")
    sentence = re.sub(r"([<>*_\[\]`])", r"\\\1", sentence)
    return f'<a id="{name}"></a>**{name}** · {sentence}.<br>'


def _command_line() -> str:
    import argparse

    from aerokit.apps.cli.main import make_parser

    text = ["# aerokit.apps.cli: the command line\n"]

    def append_help(parser: argparse.ArgumentParser, level: int) -> None:
        text.append(f"{'#' * level} {parser.prog}\n\n```text\n{parser.format_help().rstrip()}\n```\n")
        for action in parser._actions:
            if isinstance(action, argparse._SubParsersAction):
                for subparser in dict.fromkeys(action.choices.values()):
                    append_help(subparser, min(level + 1, 4))

    append_help(make_parser(), 2)
    return "\n".join(text)


SOURCE_PAGES = {
    **{
        f"src/{name.replace('.', '/')}{end}": f"reference/{page.name}.md"
        for page in REFERENCE_PAGES
        for name in page.modules
        for end in (".py", "/__init__.py")
    },
    "src/aerokit/testing/clock.py": "reference/testing.md",
    "src/aerokit/vehicle/state/states.py": "reference/vehicle.md",
}
"""Source files that pages link to: their reference pages."""
