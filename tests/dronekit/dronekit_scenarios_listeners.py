"""Scenarios: notifications, their order, and waiting for them."""

from __future__ import annotations

import threading
from typing import Any

from dronekit_scenarios_state import POSITION
from dronekit_stage import Stage, caught, scenario

# ------------------------------------------------------------------------------------ listeners


@scenario(
    [
        "global_relative_frame of Locations",
        "* global_relative_frame of Locations",
        "location.global_relative_frame of Vehicle",
        "* location.global_relative_frame of Vehicle",
        "global_frame of Locations",
        "* global_frame of Locations",
        "location.global_frame of Vehicle",
        "* location.global_frame of Vehicle",
        "location of Vehicle",
        "* location of Vehicle",
        "velocity of Vehicle",
        "* velocity of Vehicle",
    ]
)
def row_18_order_of_notifications(stage: Stage) -> Any:
    events: list[str] = []
    vehicle, locations = stage.vehicle, stage.vehicle.location

    def every(source: Any, name: str, value: Any) -> None:
        if name.startswith(("glo", "loc", "vel")):
            events.append(f"* {name} of {type(source).__name__}")

    def one(source: Any, name: str, value: Any) -> None:
        events.append(f"{name} of {type(source).__name__}")

    vehicle.add_attribute_listener("*", every)
    locations.add_attribute_listener("*", every)
    for name in ("velocity", "location", "location.global_frame", "location.global_relative_frame"):
        vehicle.add_attribute_listener(name, one)
    for name in ("global_frame", "global_relative_frame"):
        locations.add_attribute_listener(name, one)
    stage.report("GLOBAL_POSITION_INT", **POSITION)
    return events


@scenario(
    [
        ("armed", "True"),
        ("mode", "VehicleMode:LOITER"),
        ("system_status", "SystemStatus:ACTIVE"),
        ("attitude", "Attitude:pitch=0.5,yaw=0.0,roll=0.25"),
        ("attitude", "Attitude:pitch=0.5,yaw=0.0,roll=0.25"),
    ]
)
def row_19_states_once_sensors_each_time(stage: Stage) -> Any:
    events = stage.listen("armed", "mode", "system_status", "attitude")
    stage.fc.base_mode, stage.fc.custom_mode, stage.fc.system_status = 129, 5, 4
    stage.fc.beat()
    stage.fc.beat()
    stage.fc.report("ATTITUDE", roll=0.25, pitch=0.5)
    stage.report("ATTITUDE", roll=0.25, pitch=0.5)
    return [(name, value) for _, name, value in events]


@scenario(
    (
        ["first 271", "second 271", "first 5", "second 5"],
        ["ERROR Exception in attribute handler for heading"] * 2,
    )
)
def row_20_listener_that_raises(stage: Stage) -> Any:
    calls: list[str] = []

    def first(_: Any, name: str, value: Any) -> None:
        calls.append(f"first {value}")
        raise ValueError("of the program")

    stage.vehicle.add_attribute_listener("heading", first)
    stage.vehicle.add_attribute_listener("heading", lambda _, name, value: calls.append(f"second {value}"))
    with stage.logged(having="heading") as lines:
        stage.report("VFR_HUD", heading=271)
        stage.report("VFR_HUD", heading=5)
    return calls, lines


@scenario((["heading"], "None", "None", "ValueError"))
def row_21_adding_and_removing(stage: Stage) -> Any:
    calls: list[str] = []

    def listener(_: Any, name: str, value: Any) -> None:
        calls.append(name)

    def other(_: Any, name: str, value: Any) -> None: ...

    vehicle = stage.vehicle
    vehicle.add_attribute_listener("heading", listener)
    vehicle.add_attribute_listener("heading", listener)
    stage.report("VFR_HUD", heading=271)
    vehicle.remove_attribute_listener("heading", listener)
    stage.report("VFR_HUD", heading=272)
    again = caught(lambda: vehicle.remove_attribute_listener("heading", listener))
    unknown = caught(lambda: vehicle.remove_attribute_listener("no such name", listener))
    vehicle.add_attribute_listener("heading", other)
    foreign = caught(lambda: vehicle.remove_attribute_listener("heading", listener))
    return calls, again, unknown, foreign.split(":")[0]


@scenario(
    [
        "HEARTBEAT GUIDED",
        "* HEARTBEAT GUIDED",
        "VFR_HUD 271",
        "* VFR_HUD 271",
    ]
)
def message_listeners_after_attributes(stage: Stage) -> Any:
    stage.fc.heartbeat_s = None
    stage.settle()
    calls: list[str] = []

    def text(vehicle: Any, name: str) -> str:
        return f"{name} {vehicle.mode.name if name == 'HEARTBEAT' else vehicle.heading}"

    def every(vehicle: Any, name: str, message: Any) -> None:
        if message.get_type() in ("HEARTBEAT", "VFR_HUD"):
            calls.append(f"* {text(vehicle, message.get_type())}")

    def one(vehicle: Any, name: str, message: Any) -> None:
        calls.append(text(vehicle, name))

    stage.vehicle.add_message_listener("*", every)
    stage.vehicle.add_message_listener("HEARTBEAT", one)
    stage.vehicle.add_message_listener("HEARTBEAT", one)
    stage.vehicle.on_message(["VFR_HUD", "RANGEFINDER"])(one)
    stage.reached()
    stage.fc.custom_mode = 4
    stage.beat()
    stage.report("VFR_HUD", heading=271)
    stage.vehicle.remove_message_listener("HEARTBEAT", one)
    stage.vehicle.remove_message_listener("HEARTBEAT", one)
    stage.vehicle.remove_message_listener("*", every)
    stage.beat()
    return calls


@scenario((["first", "second"], ["ERROR Exception in message handler for VFR_HUD"]))
def message_listener_that_raises(stage: Stage) -> Any:
    calls: list[str] = []

    def first(vehicle: Any, name: str, message: Any) -> None:
        calls.append("first")
        raise ValueError("of the program")

    stage.vehicle.add_message_listener("VFR_HUD", first)
    stage.vehicle.add_message_listener("VFR_HUD", lambda *_: calls.append("second"))
    stage.reached()
    with stage.logged(having="VFR_HUD") as lines:
        stage.report("VFR_HUD", heading=271)
    return calls, lines


@scenario(["one X 1", "every X 1"])
def message_listeners_notified_by_the_program(stage: Stage) -> Any:
    calls: list[str] = []
    stage.vehicle.add_message_listener("*", lambda _, name, value: calls.append(f"every {name} {value}"))
    stage.vehicle.add_message_listener("X", lambda _, name, value: calls.append(f"one {name} {value}"))
    stage.vehicle.notify_message_listeners("X", 1)
    return [call for call in calls if " X " in call]


@scenario((["a 1", "a 1", "b 1", "b 2"], True))
def own_attributes(stage: Stage) -> Any:
    events = stage.listen("a", "b")
    for value in (1, 1):
        stage.vehicle.notify_attribute_listeners("a", value)
    for value in (1, 1, 2):
        stage.vehicle.notify_attribute_listeners("b", value, cache=True)
    return [f"{name} {value}" for _, name, value in events], stage.vehicle.wait_ready("a", "b", timeout=1)


@scenario([("mode", "VehicleMode:LOITER"), ("attitude", "Attitude:pitch=0.0,yaw=0.5,roll=0.0")])
def listener_of_several_names(stage: Stage) -> Any:
    events: list[tuple[str, str]] = []

    def listener(vehicle: Any, name: str, value: Any) -> None:
        events.append((name, str(value)))

    stage.vehicle.on_attribute(["mode", "attitude"])(listener)
    stage.fc.custom_mode = 5
    stage.beat()
    stage.report("ATTITUDE", yaw=0.5)
    return events


@scenario(True, is_slow=True)
def last_heartbeat(stage: Stage) -> Any:
    ages: list[float] = []
    enough = threading.Event()

    def listener(_: Any, name: str, value: float) -> None:
        ages.append(value)
        if len(ages) > 3:
            enough.set()

    stage.vehicle.add_attribute_listener("last_heartbeat", listener)
    assert enough.wait(100)
    return all(isinstance(age, float) and 0 <= age < 10 for age in [*ages, stage.vehicle.last_heartbeat])


# -------------------------------------------------------------------------------------- waiting


@scenario(
    (
        "TimeoutError: wait_ready experienced a timeout after 0.4 seconds.",
        "False",
        "ValueError: wait_ready expects one or more string arguments.",
        "True",
        ["nosuch"],
    ),
    is_slow=True,
)
def row_39_wait_ready(stage: Stage) -> Any:
    missing: list[str] = []
    vehicle = stage.vehicle
    return (
        caught(lambda: vehicle.wait_ready("nosuch", timeout=0.4)),
        caught(
            lambda: vehicle.wait_ready(
                "nosuch",
                timeout=0.4,
                raise_exception=False,
                still_waiting_callback=missing.extend,
                still_waiting_interval=0.1,
            )
        ),
        caught(lambda: vehicle.wait_ready(5)),
        caught(lambda: vehicle.wait_ready("mode", "armed")),
        sorted(set(missing)),
    )


@scenario("TimeoutError: wait_ready experienced a timeout after 2 seconds. attitude,gps_0", is_slow=True)
def wait_ready_names_of_true(stage: Stage) -> Any:
    missing: set[str] = set()
    stage.vehicle.wait_ready("parameters", "armed", "mode")
    text = caught(
        lambda: stage.vehicle.wait_ready(
            True, timeout=2, still_waiting_callback=missing.update, still_waiting_interval=0.1
        )
    )
    return f"{text} {','.join(sorted(missing))}"


@scenario(
    [
        "CRITICAL text 0",
        "CRITICAL text 1",
        "CRITICAL text 2",
        "ERROR text 3",
        "WARNING text 4",
        "INFO text 5",
        "INFO text 6",
        "DEBUG text 7",
    ]
)
def status_texts(stage: Stage) -> Any:
    with stage.logged("autopilot", having="text") as lines:
        for severity in range(8):
            stage.fc.report("STATUSTEXT", severity=severity, text=f" text {severity}  ".encode())
        stage.settle()
    return lines
