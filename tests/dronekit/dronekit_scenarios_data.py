"""Scenarios: parameters and missions."""

from __future__ import annotations

from typing import Any

from dronekit_scenarios_orders import HOME
from dronekit_stage import Stage, caught, scenario
from flight_controller import FlightController
from flight_controller_services import Item

TAKEOFF = Item(22, 0.0, 0.0, 10.0)
FIRST, SECOND, THIRD = (Item(16, -35.5 - number / 4, 149.25, 20.0 + number) for number in range(3))

# ----------------------------------------------------------------------------------- parameters


@scenario(
    (
        (1.0, "float", 1.0),
        "KeyError: 'NOPE'",
        None,
        None,
        "APIException: Cannot delete value from parameters list.",
        (True, True, False),
        3,
        ["BAR", "FOO", "THR_MIN"],
        [("BAR", 2.5), ("FOO", 1.0), ("THR_MIN", 130.0)],
    )
)
def row_32_parameters(stage: Stage) -> Any:
    parameters = stage.vehicle.parameters
    return (
        (parameters["foo"], type(parameters["foo"]).__name__, parameters["FOO"]),
        caught(lambda: parameters["NOPE"]),
        parameters.get("NOPE"),
        parameters.get("NOPE", True),
        caught(lambda: parameters.__delitem__("FOO")),
        ("foo" in parameters, "FOO" in parameters, "NOPE" in parameters),
        len(parameters),
        sorted(parameters),
        sorted(parameters.items()),
    )


@scenario(([("FOO", 3.0, 9)], 3.0, 3.0, True, 4.0))
def row_33_setting(stage: Stage) -> Any:
    parameters = stage.vehicle.parameters
    parameters.wait_ready()

    def order() -> None:
        parameters["FOO"] = 3

    sent = stage.sent_by(order, "PARAM_SET")
    frames = sorted({(frame.param_id, frame.param_value, frame.param_type) for frame in sent})
    kept = stage.fc.parameters.values["FOO"]
    return frames, kept, parameters["FOO"], parameters.set("foo", 4), parameters["FOO"]


def all_read(stage: Stage) -> None:
    """Wait for the end of the download: an old value after PARAM_SET would cause a correct retry."""
    stage.vehicle.parameters.wait_ready()
    stage.reached()


@scenario(([7.0], False), is_slow=True, is_kept=False)
def row_33_echoes_lost_for_good(stage: Stage) -> Any:
    all_read(stage)
    stage.fc.answers["PARAM_SET"] = lambda _: None
    stage.fc.parameters.is_silent = True
    result = stage.vehicle.parameters.set("FOO", 7, retries=1)
    stage.reached()
    return [frame.param_value for frame in stage.fc.received("PARAM_SET")], result


@scenario((1, ["ERROR timeout setting parameter BAR to 7.000000"]), is_slow=True, is_kept=False)
def row_33_assignment_never_raises(stage: Stage) -> Any:
    all_read(stage)
    stage.fc.answers["PARAM_SET"] = lambda _: None
    stage.fc.parameters.is_silent = True
    with stage.logged(having="BAR") as lines:
        stage.vehicle.parameters["BAR"] = 7
        stage.settle()
    stage.reached()
    return len(stage.fc.received("PARAM_SET")), lines


@scenario((True, [7.0]), is_slow=True, is_kept=False)
def row_33_one_echo_lost(stage: Stage) -> Any:
    all_read(stage)
    stage.fc.parameters.lost_echoes = 1
    result = stage.vehicle.parameters.set("FOO", 7)
    return result, [frame.param_value for frame in stage.fc.received("PARAM_SET")]


@scenario((True, 0.10000000149011612))
def row_34_single_precision(stage: Stage) -> Any:
    return stage.vehicle.parameters.set("FOO", 0.1), stage.vehicle.parameters["FOO"]


@scenario(
    (
        [("Parameters", "FOO", 33.0)],
        [("Parameters", "FOO", 33.0), ("Parameters", "BAR", 4.0)],
        ["FOO"],
    )
)
def row_35_parameter_listeners(stage: Stage) -> Any:
    parameters = stage.vehicle.parameters
    parameters.wait_ready()
    one: list[Any] = []
    every: list[Any] = []
    decorated: list[str] = []

    def listener(source: Any, name: str, value: float) -> None:
        one.append((type(source).__name__, name, value))

    parameters.add_attribute_listener("foo", listener)
    parameters.add_attribute_listener("*", lambda source, *rest: every.append((type(source).__name__, *rest)))
    parameters.on_attribute("foo")(lambda _, name, value: decorated.append(name))
    for _ in range(2):
        stage.fc.parameters.values["FOO"] = 33.0
        stage.fc.parameters.report("FOO")
    stage.settle()
    parameters.remove_attribute_listener("foo", listener)
    stage.fc.parameters.values["BAR"] = 4.0
    stage.fc.parameters.report("BAR")
    stage.settle()
    return one, every, decorated


@scenario([("MINE", 1.5), ("MINE", 1.5), ("MINE", 2.5)])
def parameters_notified_by_the_program(stage: Stage) -> Any:
    notified: list[tuple[str, float]] = []
    parameters = stage.vehicle.parameters
    parameters.on_attribute(attr_name="mine")(lambda _, name, value: notified.append((name, value)))
    for value in (1.5, 1.5):
        parameters.notify_attribute_listeners("mine", value)
    for value in (2.5, 2.5):
        parameters.notify_attribute_listeners("mine", value, cache=True)
    return notified


@scenario((1, True), prepare=lambda fc: fc.parameters.lost_once.add("BAR"))
def parameters_lost_on_the_way(stage: Stage) -> Any:
    stage.vehicle.parameters.wait_ready()
    return len(stage.fc.received("PARAM_REQUEST_LIST")), stage.vehicle.parameters["BAR"] == 2.5


@scenario(True)
def parameters_are_notified_when_complete(stage: Stage) -> Any:
    return stage.vehicle.wait_ready("parameters", timeout=100) and len(stage.vehicle.parameters) == 3


# ------------------------------------------------------------------------------------- missions


def keep_three(fc: FlightController) -> None:
    fc.missions.items = [HOME, FIRST, SECOND, THIRD]
    fc.missions.asks_int = False  # DroneKit does not support MISSION_ITEM_INT.


def downloaded(stage: Stage) -> Any:
    commands = stage.vehicle.commands
    commands.download()
    commands.wait_ready()
    return commands


@scenario(
    (
        (3, 3),
        (1, 16, -35.5, 149.25, 20.0, 3),
        ["IndexError: Index 3 out of range.", "TypeError: Invalid argument type."],
        [1, 2],
        [1, 2, 3],
        "LocationGlobal:lat=-35.363,lon=149.165,alt=584.0",
        ["commands"],
    ),
    prepare=keep_three,
)
def row_36_download(stage: Stage) -> Any:
    events = stage.listen("commands")
    commands = downloaded(stage)
    home = stage.vehicle.home_location
    home.lat, home.lon = round(home.lat, 3), round(home.lon, 3)
    first = commands[0]
    stage.settle()
    return (
        (len(commands), commands.count),
        (first.seq, first.command, first.x, first.y, first.z, first.frame),
        [caught(lambda: commands[3]), caught(lambda: commands["a"])],
        [command.seq for command in commands[0:2]],
        [command.seq for command in commands],
        str(home),
        [name for _, name, _ in events],
    )


def waypoint(stage: Stage, item: Item) -> Any:
    return stage.dronekit.Command(0, 0, 0, item.frame, item.command, 0, 0, *item.params, item.x, item.y, item.z)


def kept(stage: Stage) -> list[tuple[int, float, float, float]]:
    """The mission on the vehicle; home as its command only."""
    home, *rest = stage.fc.missions.items
    return [(home.command, 0, 0, 0), *((item.command, item.x, item.y, item.z) for item in rest)]


UPLOADED = [(16, 0, 0, 0), (22, 0.0, 0.0, 10.0), (16, -35.75, 149.25, 21.0)]


@scenario((UPLOADED, 2, [(1, 22), (2, 16)], UPLOADED), prepare=keep_three)
def row_37_upload(stage: Stage) -> Any:
    commands = downloaded(stage)
    commands.clear()
    assert len(commands) == 0
    for item in (TAKEOFF, SECOND):
        commands.add(waypoint(stage, item))
    stage.vehicle.commands.upload()
    first = kept(stage)
    observed = [(item.seq, item.command) for item in downloaded(stage)]
    return first, len(commands), observed, kept(stage)


@scenario((UPLOADED, []), prepare=keep_three)
def flush_uploads_what_changed(stage: Stage) -> Any:
    commands = downloaded(stage)
    commands.clear()
    for item in (TAKEOFF, SECOND):
        commands.add(waypoint(stage, item))
    stage.vehicle.flush()
    return kept(stage), stage.sent_by(stage.vehicle.flush, "MISSION_COUNT", "MISSION_CLEAR_ALL")


@scenario(
    [(16, 0, 0, 0), (16, -35.5, 149.25, 20.0), (22, 0.0, 0.0, 10.0), (16, -36.0, 149.25, 22.0)],
    prepare=keep_three,
)
def changing_one_item(stage: Stage) -> Any:
    commands = downloaded(stage)
    commands[1] = waypoint(stage, TAKEOFF)
    commands.upload()
    return kept(stage)


@scenario(([2], 3), prepare=keep_three)
def row_38_next(stage: Stage) -> Any:
    sent = stage.sent_by(lambda: setattr(stage.vehicle.commands, "next", 2), "MISSION_SET_CURRENT")
    stage.report("MISSION_CURRENT", seq=3)
    return [frame.seq for frame in sent], stage.vehicle.commands.next
