"""The reference: which module stands on which page, and the pages themselves, for mkdocstrings to fill."""

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
class Room:
    """One page: modules whose public names it has, in this order."""

    page: str
    title: str
    about: str
    modules: tuple[str, ...]


ROOMS = (
    Room("aerokit", "aerokit", "Connecting, and what a program says", ("aerokit",)),
    Room("vehicle", "aerokit.vehicle: Vehicle", "State, actions, and the way to its parts",
         (f"{VEHICLE}.vehicle", f"{VEHICLE}.connect")),
    Room("fleets", "aerokit.fleets: Fleet", "Many vehicles as one",
         tuple(f"aerokit.fleets.{name}" for name in (
             "fleet", "members", "policy", "events", "formation", "formations", "separation", "paths", "shows.show",
             "shows.clocks"))),
    Room("cells", "Cells and subscriptions", "Values with their age; messages and events as they come",
         ("aerokit.connection.cells", "aerokit.connection.bus")),
    Room("state", "Values of the state", "What cells hold",
         (f"{VEHICLE}.state.movement", f"{VEHICLE}.state.condition", f"{VEHICLE}.state.equipment",
          f"{VEHICLE}.state.status_text")),
    Room("guided", "Set-point streams, posted orders", "`vehicle.guided`, `vehicle.posted`",
         (f"{VEHICLE}.commanding.guided", f"{VEHICLE}.commanding.setpoints", f"{VEHICLE}.commanding.posted")),
    Room("missions", "Missions, fences, rally points", "`vehicle.mission`, `.fence`, `.rally`, and `aerokit.missions`",
         (f"{VEHICLE}.missions.mission", f"{VEHICLE}.missions.plans", "aerokit.missions")),
    Room("parameters", "Parameters", "`vehicle.parameters`, and `aerokit.parameters`",
         (f"{VEHICLE}.parameters.parameters", f"{VEHICLE}.parameters.writing", f"{VEHICLE}.parameters.transaction",
          "aerokit.parameters")),
    Room("files", "Files and logs", "`vehicle.files`, `vehicle.logs`",
         (f"{VEHICLE}.files.files", f"{VEHICLE}.files.logs", f"{VEHICLE}.files.log_paths")),
    Room("camera", "Cameras", "`vehicle.camera`, `vehicle.camera_at`",
         (f"{VEHICLE}.camera.cameras", f"{VEHICLE}.camera.values", f"{VEHICLE}.camera.capture", "aerokit.video")),
    Room("gimbal", "Gimbals", "`vehicle.gimbal`, `vehicle.gimbals`",
         (f"{VEHICLE}.gimbal.gimbal", f"{VEHICLE}.gimbal.control", f"{VEHICLE}.gimbal.rates",
          f"{VEHICLE}.gimbal.device")),
    Room("components", "Components", "`vehicle.component(id)`: what else is on board",
         (f"{VEHICLE}.components.component", f"{VEHICLE}.components.settings")),
    Room("errors", "aerokit.errors", "The tree of exceptions", ("aerokit.errors",)),
    Room("events", "aerokit.events", "What is told when it happens", ("aerokit.events",)),
    Room("sync", "aerokit.sync", "The blocking twin", ("aerokit.sync",)),
    Room("dronekit", "aerokit.dronekit", "The classic API", ("aerokit.dronekit",)),
    Room("sim", "aerokit.sim", "Simulated vehicles", ("aerokit.sim", "aerokit.sim.kinds", "aerokit.sim.picture")),
    Room("testing", "aerokit.testing", "For tests of your program", ("aerokit.testing",)),
    Room("transport", "aerokit.transport", "Bytes in, bytes out", ("aerokit.transport",)),
    Room("hub", "aerokit.hub", "Links joined into one network", ("aerokit.hub",)),
    Room("mavlink", "aerokit.mavlink", "The wire", ("aerokit.mavlink", "aerokit.mavlink.pymavlink")),
    Room("protocols", "aerokit.protocols", "MAVLink's microservices without IO",
         tuple(f"aerokit.protocols.{name}" for name in (
             "exchange", "command", "parameter_list", "parameter_requests", "extended_parameters", "missions",
             "mission_download", "mission_upload", "ftp", "ftp_transfer", "logs"))),
    Room("autopilots", "aerokit.autopilots", "What differs between firmwares", ("aerokit.autopilots",)),
    Room("convert", "aerokit.logs.convert", "Logs in other formats", ("aerokit.logs.convert",)),
    Room("flights", "aerokit.logs.flights", "Flight logs as what was flown", ("aerokit.logs.flights",)),
    Room("report", "aerokit.logs.report", "A flight as one HTML file", ("aerokit.logs.report",)),
    Room("foxglove", "aerokit.apps.foxglove", "Vehicles live in Foxglove", ("aerokit.apps.foxglove",)),
    Room("network", "aerokit.apps.network", "State for other machines and languages", ("aerokit.apps.network",)),
    Room("serve", "aerokit.apps.serve", "A page and an API for vehicles", ("aerokit.apps.serve",)),
    Room("monitor", "aerokit.apps.monitor", "Vehicles in the terminal", ("aerokit.apps.monitor.app",)),
)  # fmt: skip
MADE = {
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
    """Path on the site, text."""
    yield "reference/index.md", _index()
    at = _rooms_of_names()
    for room in ROOMS:
        yield f"reference/{room.page}.md", _page(room, at)
    yield "reference/messages.md", _messages()
    yield "reference/enums.md", _enums()
    yield "reference/cli.md", _command_line()


def _rooms_of_names() -> dict[str, Room]:
    """Where each object stands: in the first room that has its module; what `aerokit` exports, in its own room."""
    at: dict[str, Room] = {}
    for room in (*ROOMS[1:], ROOMS[0]):
        for name in room.modules:
            for place in _places(importlib.import_module(name)):
                at.setdefault(place, room)
    return at


def _index() -> str:
    rows = [(room.page, room.title, room.about) for room in ROOMS]
    rows += [(page, TITLES[page], about) for page, about in MADE.items()]
    table = "".join(f"| [{title}]({page}.md) | {about} |\n" for page, title, about in rows)
    text = (
        "Every public name, with all that it inherits. Import from the packages that these pages name; a module"
        " that stands on none of them is internal and may change with any version."
    )
    return f"# Reference\n\n{text}\n\n| | |\n|---|---|\n{table}"


def _page(room: Room, at: dict[str, Room]) -> str:
    """Each object of a room; and links to those that its modules export and that stand in another one."""
    text = [f"# {room.title}\n"]
    for name in room.modules:
        module = importlib.import_module(name)
        places = list(dict.fromkeys(_places(module)))
        if len(room.modules) > 1:
            text.append(f"## {name}\n")
        if hasattr(module, "__path__"):  # a package says what it is for
            text.append(f"{inspect.getdoc(module)}\n")
        elsewhere = [f"[`{place.rpartition('.')[2]}`][{place}]" for place in places if at[place] is not room]
        if elsewhere:
            text.append(f"On pages of their own: {', '.join(elsewhere)}.\n")
        level = 3 if len(room.modules) > 1 else 2
        here = [place for place in places if at[place] is room and place not in _told(text)]
        text += [f"::: {place}\n    options:\n      heading_level: {level}\n" for place in here]
    return "\n".join(text)


def _told(text: list[str]) -> set[str]:
    return {line[4:].partition("\n")[0] for line in text if line.startswith("::: ")}


def _places(module: ModuleType) -> Iterator[str]:
    """Where each public name of a module is made; for what does not tell, such as a constant, where it is exported."""
    for name in getattr(module, "__all__", ()):
        item = getattr(module, name)
        if inspect.ismodule(item):
            continue
        home, own_name = str(getattr(item, "__module__", "")), getattr(item, "__name__", "")
        is_ours = home.partition(".")[0] == "aerokit"
        if is_ours and getattr(importlib.import_module(home), own_name or name, None) is item:
            yield f"{home}.{own_name or name}"
        elif is_ours or own_name != name:  # not what another library exports by this name
            yield f"{module.__name__}.{name}"


# ------------------------------------------------------------------------------------ generated code, in short


def _messages() -> str:
    from aerokit import messages
    from aerokit.mavlink.message import Message

    told = [
        "# aerokit.messages\n",
        "`from aerokit import messages`; `help(messages.Attitude)` has fields with types and units.\n",
    ]
    for name in sorted(messages.__all__):
        message = getattr(messages, name)
        if inspect.isclass(message) and issubclass(message, Message):
            fields = ", ".join(f"`{field.name}`" for field in message.FIELDS)
            told.append(f"{_item(name, message)} {fields}\n")
    return "\n".join(told)


def _enums() -> str:
    from aerokit import enums

    told = [
        "# aerokit.enums\n",
        "`from aerokit import enums`; `help(enums.MavCmd)` says what each member means.\n",
    ]
    for name in sorted(enums.__all__):
        enum: type[enum_kinds.IntEnum] = getattr(enums, name)
        if inspect.isclass(enum):
            members = ", ".join(f"`{member}` {int(value)}" for member, value in enum.__members__.items())
            told.append(f"{_item(name, enum)} {members}\n")
    return "\n".join(told)


def _item(name: str, item: type) -> str:
    """A paragraph, to be linked to, with the first sentence of the standard's text."""
    text = " ".join((inspect.getdoc(item) or "").split())
    sentence = re.split(r"(?<!e\.g)(?<!i\.e)\. ", text)[0].rstrip(".")
    sentence = re.sub(r"([<>*_\[\]`])", r"\\\1", sentence)
    return f'<a id="{name}"></a>**{name}** · {sentence}.<br>'


def _command_line() -> str:
    import argparse

    from aerokit.apps.cli.main import make_parser

    text = ["# aerokit.apps.cli: the command line\n"]

    def tell(parser: argparse.ArgumentParser, level: int) -> None:
        text.append(f"{'#' * level} {parser.prog}\n\n```text\n{parser.format_help().rstrip()}\n```\n")
        for action in parser._actions:
            if isinstance(action, argparse._SubParsersAction):
                for each in dict.fromkeys(action.choices.values()):
                    tell(each, min(level + 1, 4))

    tell(make_parser(), 2)
    return "\n".join(text)


HOMES = {
    **{
        f"src/{name.replace('.', '/')}{end}": f"reference/{room.page}.md"
        for room in ROOMS
        for name in room.modules
        for end in (".py", "/__init__.py")
    },
    "src/aerokit/testing/clock.py": "reference/testing.md",
    "src/aerokit/vehicle/state/states.py": "reference/vehicle.md",
}
"""Files of the sources that pages link to: where they are on the site."""
