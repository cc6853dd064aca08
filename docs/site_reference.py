"""Generates the reference pages, which mkdocstrings fills."""

from __future__ import annotations

import ast
import enum as enum_kinds
import functools
import importlib
import inspect
import math
import re
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROLE = re.compile(r":(?:class|func|meth|mod|attr|data|exc):(?=`)")


@dataclass(frozen=True)
class Page:
    """One page of the reference."""

    name: str
    title: str
    about: str
    imports: tuple[str, ...] = ()
    """Modules that users import. The page lists all their exported names."""
    holders: tuple[str, ...] = ()
    """Other modules. The page lists their value classes, and their classes that the public API returns or accepts."""
    names: tuple[str, ...] = ()
    """Full names of functions in ``holders`` that users import."""
    search_boost: float = 1.0

    @property
    def modules(self) -> tuple[str, ...]:
        return self.imports + self.holders


GROUPS: dict[str, tuple[Page, ...]] = {
    "import aerokit": (
        Page("aerokit", "aerokit", "Connecting, and the most common names", ("aerokit",), search_boost=2.5),
        Page("vehicle", "Vehicle", "Actions, state, and access to everything on board",
             holders=("aerokit.vehicle.vehicle",), search_boost=3),
        Page("cells", "StateCell and Subscription", "Values with their age; streams of messages and events",
             holders=("aerokit.connection.cells", "aerokit.connection.bus"), search_boost=2.5),
        Page("state", "Values of the state", "What `vehicle.attitude.value`, `vehicle.batteries.value` … return",
             holders=("aerokit.vehicle.state.movement", "aerokit.vehicle.state.condition",
                      "aerokit.vehicle.state.equipment", "aerokit.vehicle.state.measurements"), search_boost=1.5),
        Page("guided", "vehicle.guided and vehicle.posted", "Set-point streams, and orders without waiting",
             holders=("aerokit.vehicle.commanding.guided", "aerokit.vehicle.commanding.setpoints",
                      "aerokit.vehicle.commanding.follow",
                      "aerokit.vehicle.commanding.posted"), search_boost=2),
        Page("external", "vehicle.external and vehicle.sticks", "Sticks, measurements and precision landing",
             holders=("aerokit.vehicle.commanding.sticks", "aerokit.vehicle.external.external",
                      "aerokit.vehicle.external.streams", "aerokit.vehicle.external.values",
                      "aerokit.vehicle.external.landing"), search_boost=2),
        Page("plans", "vehicle.mission, .fence and .rally", "Missions, fences and rally points on board",
             holders=("aerokit.vehicle.missions.mission", "aerokit.vehicle.missions.plans"), search_boost=2),
        Page("vehicle-parameters", "vehicle.parameters", "Parameters on board",
             holders=("aerokit.vehicle.parameters.parameters", "aerokit.vehicle.parameters.writing",
                      "aerokit.vehicle.parameters.transaction"), search_boost=2),
        Page("files", "vehicle.files and vehicle.logs", "Files and flight logs on board",
             holders=("aerokit.vehicle.files.files", "aerokit.vehicle.files.logs", "aerokit.vehicle.files.log_stream"),
             search_boost=2),
        Page("camera", "vehicle.camera", "Photos, video, zoom, settings",
             holders=("aerokit.vehicle.camera.cameras", "aerokit.vehicle.camera.values",
                      "aerokit.vehicle.camera.capture"),
             names=("aerokit.vehicle.camera.capture.captures_csv", "aerokit.vehicle.camera.capture.geotag_file",
                    "aerokit.vehicle.camera.capture.geotagged", "aerokit.vehicle.camera.capture.write_captures"),
             search_boost=1.75),
        Page("gimbal", "vehicle.gimbal", "Gimbals and control over them",
             holders=("aerokit.vehicle.gimbal.gimbal", "aerokit.vehicle.gimbal.control",
                      "aerokit.vehicle.gimbal.rates", "aerokit.vehicle.gimbal.device"), search_boost=1.75),
        Page("rtk", "vehicle.rtk", "Corrections for satellite receivers",
             holders=("aerokit.vehicle.rtk.rtk", "aerokit.vehicle.rtk.ntrip"), search_boost=1.5),
        Page("calibrate", "vehicle.calibrate", "Calibration of sensors, radio and ESCs",
             holders=("aerokit.vehicle.calibration.calibration", "aerokit.vehicle.calibration.values"),
             search_boost=1.5),
        Page("devices", "vehicle.actuators, .gripper(), .winch(), .shell()", "Outputs and devices; PX4's shell",
             holders=("aerokit.vehicle.devices.actuators", "aerokit.vehicle.devices.gripper",
                      "aerokit.vehicle.devices.winch", "aerokit.vehicle.devices.shell"), search_boost=1.75),
        Page("components", "vehicle.component()", "Any component on board",
             holders=("aerokit.vehicle.components.component", "aerokit.vehicle.components.settings"),
             search_boost=1.5),
        Page("onboard", "aerokit.onboard", "Your program as a component, and its ready-made parts",
             ("aerokit.onboard",), search_boost=1.5),
        Page("fleets", "Fleet", "Many vehicles together",
             holders=("aerokit.fleets.fleet", "aerokit.fleets.members", "aerokit.fleets.policy",
                      "aerokit.fleets.events", "aerokit.fleets.formation", "aerokit.fleets.formation",
                      "aerokit.fleets.separation", "aerokit.fleets.paths", "aerokit.fleets.show",
                      "aerokit.fleets.show_flight"), search_boost=1.25),
    ),
    "Modules": (
        Page("sync", "aerokit.sync", "The blocking API", ("aerokit.sync",), search_boost=0.7),
        Page("dronekit", "aerokit.dronekit", "The classic DroneKit API", ("aerokit.dronekit",)),
        Page("missions", "aerokit.missions", "Mission items, fences, rally points; `.plan` and `QGC WPL` files",
             ("aerokit.missions",), search_boost=1.75),
        Page("parameters", "aerokit.parameters", "Parameter tables, files, metadata, settings of components",
             ("aerokit.parameters",)),
        Page("errors", "aerokit.errors", "All exceptions", ("aerokit.errors",)),
        Page("events", "aerokit.events", "All events", ("aerokit.events",)),
        Page("video", "aerokit.video", "Frames of video streams", ("aerokit.video",)),
        Page("hub", "aerokit.hub", "Links joined into one network", ("aerokit.hub",), search_boost=1.5),
    ),
    "Tests": (
        Page("testing", "aerokit.testing", "Tests of your program", ("aerokit.testing",)),
        Page("sim", "aerokit.sim", "Simulated vehicles", ("aerokit.sim",)),
    ),
    "Applications": (
        Page("convert", "aerokit.logs.convert", "Logs in other formats", ("aerokit.logs.convert",)),
        Page("flights", "aerokit.logs.flights", "Flights read from logs", ("aerokit.logs.flights",)),
        Page("report", "aerokit.logs.report", "A flight as one HTML file", ("aerokit.logs.report",)),
        Page("foxglove", "aerokit.apps.foxglove", "Vehicles live in Foxglove", ("aerokit.apps.foxglove",)),
        Page("network", "aerokit.apps.network", "State for other computers and languages",
             ("aerokit.apps.network",)),
        Page("serve", "aerokit.apps.serve", "Web page and HTTP API", ("aerokit.apps.serve",)),
        Page("monitor", "aerokit.apps.monitor", "Vehicles in the terminal", ("aerokit.apps.monitor.app",)),
    ),
    "Lower layers": (
        Page("transport", "aerokit.transport", "Links", ("aerokit.transport",)),
        Page("mavlink", "aerokit.mavlink", "Frames, dialects, signing",
             ("aerokit.mavlink", "aerokit.mavlink.pymavlink"),
             names=("aerokit.mavlink.message_factory.MessageFactory",)),
        Page("protocols", "aerokit.protocols", "MAVLink's services without I/O", (
            "aerokit.protocols.exchange", "aerokit.protocols.command", "aerokit.protocols.parameter_list",
            "aerokit.protocols.parameter_requests", "aerokit.protocols.extended_parameters",
            "aerokit.protocols.missions", "aerokit.protocols.mission_download", "aerokit.protocols.mission_upload",
            "aerokit.protocols.ftp", "aerokit.protocols.ftp_transfer", "aerokit.protocols.logs",
        ), search_boost=0),
        Page("autopilots", "aerokit.autopilots", "What differs between firmwares", ("aerokit.autopilots",),
             search_boost=0),
    ),
}  # fmt: skip
"""Maps a section of the reference to its pages. Pages with a `search_boost` of 0 are not in the search index."""
GENERATED_PAGES = {
    "messages": ("Modules", "aerokit.messages", "Every message of the standard dialect"),
    "enums": ("Modules", "aerokit.enums", "Every enum of the standard dialect"),
    "cli": ("Applications", "aerokit on the command line", "Every command and option"),
}
"""Maps a page that is generated without mkdocstrings to its section, title and description."""
REFERENCE_PAGES = tuple(page for pages in GROUPS.values() for page in pages)
EXAMPLES = Path(__file__).parent / "reference-examples.md"
EXAMPLE = re.compile(r"^## (?P<name>\S+)\n\n```python[^\n]*\n(?P<code>.*?)^```$", re.DOTALL | re.MULTILINE)
WORD = re.compile(r"[A-Za-z_]\w*")
ASSIGNED = re.compile(r"^ +self\.[a-z]\w*(?:: (.+))? = ([A-Z]\w+)?", re.MULTILINE)
"""Matches the assignment of a public attribute in a method: its annotation, and the class that is called."""


def example_names() -> list[str]:
    """Return the entries that have an example: ``connect``, ``Vehicle.arm``, ``missions.waypoint``."""
    return [example["name"] for example in EXAMPLE.finditer(EXAMPLES.read_text(encoding="utf-8"))]


def navigation() -> list[Any]:
    """Return the pages of the tab "Reference", in their sections."""
    sections = {group: [f"reference/{page.name}.md" for page in pages] for group, pages in GROUPS.items()}
    for name, (group, _, _) in GENERATED_PAGES.items():
        sections[group].append(f"reference/{name}.md")
    return ["reference/index.md", *({group: pages} for group, pages in sections.items())]


def reference_pages(listing: Listing | None = None) -> Iterator[tuple[str, str]]:
    """Yield the path on the site and the text of each reference page."""
    yield "reference/index.md", _index()
    listing = listing or Listing()
    for page in REFERENCE_PAGES:
        yield f"reference/{page.name}.md", _page(page, listing)
    yield "reference/messages.md", _messages()
    yield "reference/enums.md", _enums()
    yield "reference/cli.md", _command_line()


# ------------------------------------------------------------------------------------ public names


@dataclass(frozen=True)
class Entry:
    """One public object."""

    path: str
    """Path from which users import the object, such as ``aerokit.Vehicle``; otherwise the path of its definition."""
    item: Any
    page: Page

    @property
    def name(self) -> str:
        return self.path.rpartition(".")[2]

    @property
    def is_imported(self) -> bool:
        """True for objects that users import, and for value classes. Other classes are created only by the library."""
        module = self.path.rpartition(".")[0]
        return module not in self.page.holders or bool(getattr(self.item, "__match_args__", ()))


class Listing:
    """Index of all public objects, with their pages."""

    def __init__(self) -> None:
        self.exports = {module: dict(_exports(module)) for page in REFERENCE_PAGES for module in page.imports}
        self._held = [
            (page, module, name, item)
            for page in REFERENCE_PAGES
            for module in page.holders
            for name, item in _exports(module)
            if inspect.isclass(item) and item.__module__ == module
        ]
        self._pages_of_modules = {module: page for page in REFERENCE_PAGES for module in page.modules}
        self.entries: dict[str, Entry] = {}
        for page in REFERENCE_PAGES:
            for module in page.imports:
                for name, item in self.exports[module].items():
                    home = self._home(name, item) or page
                    self.entries.setdefault(_key(module, name, item), Entry(f"{module}.{name}", item, home))
            for path in page.names:
                module, _, name = path.rpartition(".")
                item = getattr(importlib.import_module(module), name)
                self.entries[_key(module, name, item)] = Entry(path, item, page)
        self._add_held_classes()
        with_example = dict.fromkeys(self.find(name)[0].path for name in example_names())
        self._ranks = {path: rank for rank, path in enumerate(with_example)}

    def _home(self, name: str, item: Any) -> Page | None:
        """Return the page of the module that defines an object, or of a parent package that exports it."""
        module = str(getattr(item, "__module__", ""))
        while module.count("."):
            page = self._pages_of_modules.get(module)
            if page and (module in page.holders or name in self.exports[module]):
                return page
            module = module.rpartition(".")[0]
        return None

    def _add_held_classes(self) -> None:
        """Add value classes and classes in annotations of listed objects, until no more are found."""
        words = {name for _, _, name, item in self._held if getattr(item, "__match_args__", ())}
        words |= {word for entry in self.entries.values() for word in _annotated(entry.item)}
        while found := [row for row in self._held if row[2] in words and _key(*row[1:]) not in self.entries]:
            for page, module, name, item in found:
                self.entries[_key(module, name, item)] = Entry(f"{module}.{name}", item, page)
                words |= _annotated(item)

    def find(self, name: str) -> tuple[Entry, str]:
        """Return the entry and the member for a name like ``connect``, ``Vehicle.arm`` or ``missions.waypoint``.

        Raises:
            KeyError: there is no such entry.
        """
        paths = {entry.path.removeprefix("aerokit."): entry for entry in self.entries.values()}
        names = {entry.name: entry for entry in self.entries.values() if entry.page.holders}
        if name in paths:
            return paths[name], ""
        owner, _, member = name.rpartition(".")
        return paths.get(owner) or names[owner], member

    def of_page(self, page: Page) -> list[Entry]:
        """Return the entries of a page: those with examples first, then by module, in the order of its ``__all__``."""
        here = {key: entry for key, entry in self.entries.items() if entry.page is page}
        exported = [_key(module, *export) for module in page.modules for export in _exports(module)]
        ordered = dict.fromkeys(key for key in (*exported, *here) if key in here)
        return sorted((here[key] for key in ordered), key=lambda entry: self._ranks.get(entry.path, math.inf))

    def elsewhere(self, page: Page) -> list[Entry]:
        """Return the entries that are exported by the modules of a page but belong to other pages."""
        exported = {_key(module, *export) for module in page.imports for export in self.exports[module].items()}
        entries = [self.entries[key] for key in exported if self.entries[key].page is not page]
        return sorted(entries, key=lambda entry: entry.name)

    def classes(self) -> set[str]:
        """Return the full names of the listed classes."""
        items = [entry.item for entry in self.entries.values() if inspect.isclass(entry.item)]
        return {f"{item.__module__}.{item.__qualname__}" for item in items}

    def inherited(self, entry: Entry) -> list[str]:
        """Return the public inherited members that are not described at another listed class."""
        listed = {id(other.item) for other in self.entries.values()}
        bases = entry.item.__mro__[1:-1]
        described = {base for other in bases if id(other) in listed for base in other.__mro__}
        names = {base: {name for name in vars(base) if name[:1] != "_"} for base in bases}
        hidden = set().union(*(names[base] for base in bases if base not in described))
        return sorted(hidden.difference(*(names[base] for base in bases if base in described)))


def _key(module: str, name: str, item: Any) -> str:
    """Return the path of an object's definition, or for constants the path of its export."""
    if inspect.isclass(item) or inspect.isroutine(item):
        return f"{item.__module__}.{item.__qualname__}"
    return f"{module}.{name}"


def _exports(module_name: str) -> Iterator[tuple[str, Any]]:
    """Yield the exported objects of a module, without modules and without names of other libraries."""
    module = importlib.import_module(module_name)
    for name in getattr(module, "__all__", ()):
        item = getattr(module, name)
        is_ours = str(getattr(item, "__module__", "aerokit")).partition(".")[0] == "aerokit"
        if not inspect.ismodule(item) and (is_ours or getattr(item, "__name__", "") != name):
            yield name, item


def _annotated(item: Any) -> set[str]:
    """Return all words in the annotations of a function, or of a class and its members."""
    members = [item]
    if inspect.isclass(item):
        members += [member for base in item.__mro__ for name, member in vars(base).items() if name[:1] != "_"]
    annotations: list[Any] = []
    for member in members:
        if isinstance(member, (classmethod, staticmethod)):
            member = member.__func__
        member = getattr(member, "fget", None) or getattr(member, "func", None) or member
        own = getattr(inspect.unwrap(member) if callable(member) else member, "__annotations__", None)
        annotations += own.values() if isinstance(own, dict) else ()
    if inspect.isclass(item):
        with suppress(OSError, TypeError):  # classes that are created at run time have no source
            source = _class_sources(inspect.getsourcefile(item)).get(item.__qualname__, "")
            annotations += [" ".join(found) for found in ASSIGNED.findall(source)]
    return {word for annotation in annotations for word in WORD.findall(str(annotation))}


@functools.cache
def _class_sources(path: str) -> dict[str, str]:
    """Return the source of each class in a file by qualified name. `inspect` would parse the file for every class."""
    text = Path(path).read_text(encoding="utf-8")
    lines, found = text.splitlines(keepends=True), dict[str, str]()

    def add(body: list[ast.stmt], prefix: str) -> None:
        for node in body:
            if isinstance(node, ast.ClassDef):
                found[prefix + node.name] = "".join(lines[node.lineno - 1 : node.end_lineno])
                add(node.body, f"{prefix}{node.name}.")

    add(ast.parse(text).body, "")
    return found


# ------------------------------------------------------------------------------------ pages of mkdocstrings


def _index() -> str:
    parts = [
        "# Reference\n",
        "Every public name, with inherited members. Other modules are internal and may change with any version.\n",
    ]
    for group, pages in GROUPS.items():
        rows = [(page.name, page.title, page.about) for page in pages]
        rows += [(name, title, about) for name, (section, title, about) in GENERATED_PAGES.items() if section == group]
        table = "".join(f"| [{title}]({name}.md) | {about} |\n" for name, title, about in rows)
        parts.append(f"## {group}\n\n| | |\n|---|---|\n{table}")
    return "\n".join(parts)


def _page(page: Page, listing: Listing) -> str:
    """Return a page: exported objects of other pages as a table, then the objects of this one."""
    search = f"  boost: {page.search_boost}" if page.search_boost else "  exclude: true"
    parts = [f"---\nsearch:\n{search}\n---\n", f"# {page.title}\n", f"{page.about}.\n"]
    for name in page.imports:
        if hasattr(importlib.import_module(name), "__path__"):  # packages have a description
            parts.append(f"{inspect.getdoc(importlib.import_module(name))}\n")
    elsewhere = listing.elsewhere(page)
    if elsewhere:
        rows = "".join(f"| [`{entry.name}`][{entry.path}] | {_first_sentence(entry.item)} |\n" for entry in elsewhere)
        parts.append(f"These names have their own pages:\n\n| | |\n|---|---|\n{rows}")
    parts += [f"::: {entry.path}\n    options:\n      heading_level: 2\n" for entry in listing.of_page(page)]
    return "\n".join(parts)


def _first_sentence(item: Any) -> str:
    text = " ".join((inspect.getdoc(item) or "").split())
    sentence = re.split(r"(?<!e\.g)(?<!i\.e)[.:] ", text)[0].rstrip(".:")
    return ROLE.sub("", sentence).replace("|", "\\|")


# ------------------------------------------------------------------------------------ generated code


def _messages() -> str:
    from aerokit import messages
    from aerokit.mavlink.message import Message

    parts = [
        "---\nsearch:\n  boost: 0.3\n---\n",
        "# aerokit.messages\n",
        "`from aerokit import messages`; `help(messages.Attitude)` has fields with types and units.\n",
    ]
    for name in sorted(messages.__all__):
        message = getattr(messages, name)
        if inspect.isclass(message) and issubclass(message, Message):
            fields = ", ".join(f"`{field.name}`" for field in message.FIELDS)
            parts.append(_item(name, message, fields))
    return "\n".join(parts)


def _enums() -> str:
    from aerokit import enums

    parts = [
        "---\nsearch:\n  boost: 0.3\n---\n",
        "# aerokit.enums\n",
        "`from aerokit import enums`; `help(enums.MavCmd)` describes each member.\n",
    ]
    for name in sorted(enums.__all__):
        enum: type[enum_kinds.IntEnum] = getattr(enums, name)
        if inspect.isclass(enum):
            members = ", ".join(f"`{member}` {int(value)}" for member, value in enum.__members__.items())
            parts.append(_item(name, enum, members))
    return "\n".join(parts)


def _item(name: str, item: type, details: str) -> str:
    """Return a section with the standard's name and the first sentence of its description."""
    text = " ".join((inspect.getdoc(item) or "").split())
    standard_name, _, description = text.partition(": ")
    sentence = re.split(r"(?<!e\.g)(?<!i\.e)\. ", description)[0].rstrip(".")
    sentence = re.sub(r"([<>*_\[\]`])", r"\\\1", sentence)
    heading = f"## {name} <small>{standard_name}</small> {{ #{name} }}"
    return f"{heading}\n\n{sentence}.\n\n{details}\n{{ data-search-exclude }}\n"


def _command_line() -> str:
    import argparse

    from aerokit.apps.cli.main import make_parser

    text = [f"# {GENERATED_PAGES['cli'][1]}\n"]

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
    "src/aerokit": "reference/index.md",
    "src/aerokit/testing/clock.py": "reference/testing.md",
    "src/aerokit/vehicle/state/states.py": "reference/vehicle.md",
}
"""Maps source files that pages link to to their reference pages."""
