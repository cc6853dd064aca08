"""Reading: vehicles, missions, parameters, the OpenAPI document, the page, the stream."""

from __future__ import annotations

import asyncio
import json
import re
from contextlib import AsyncExitStack
from pathlib import Path
from unittest.mock import AsyncMock

import anyio
import httpx
import pytest
from flight_harness import open_flight
from serve_stage import HOST, TOKEN, Socket, open_stage
from starlette.applications import Starlette
from starlette.routing import Mount, Route, WebSocketRoute

import aerokit
from aerokit.apps.readiness import readiness
from aerokit.apps.serve import make_app
from aerokit.apps.serve.app import STATIC
from aerokit.apps.serve.guard import AccessControl
from aerokit.apps.serve.served_vehicles import _thin_out, _TrackPoint, ground_station_failsafe
from aerokit.apps.serve.stream import MAX_ANONYMOUS_SOCKETS, MAX_QUEUED_MESSAGES, MAX_SOCKETS, StateStream
from aerokit.autopilots import px4_custom_mode
from aerokit.errors import InvalidArgument
from aerokit.mavlink import FrameEncoder
from aerokit.mavlink.enums import MavCmd, MavMissionResult
from aerokit.mavlink.framer import Framer
from aerokit.mavlink.messages import AvailableModes, MissionAck, ParamValue
from aerokit.mavlink.tlog import read_tlog
from aerokit.missions import (
    Fence,
    FenceCircle,
    Mission,
    RallyPoints,
    rally_point,
    return_to_launch,
    take_off,
)
from aerokit.parameters import load_metadata
from aerokit.position import Position
from aerokit.sim import SimulatedCopter, SimulatedPlane, SimulatedPx4, SimulatedRover, SimulatedVehicle, simulated_link

pytestmark = pytest.mark.anyio
BEARER = {"Authorization": f"Bearer {TOKEN}"}


async def test_read_operations_return_state() -> None:
    async with open_stage() as stage:
        await stage.flight.vehicle.mission.upload(Mission([take_off(altitude_relative_m=20)]))
        stage.flight.copter.send_text(4, "<b>hello</b>")
        await anyio.sleep(1)

        async def read(path: str) -> dict[str, object]:
            answer = await stage.client.get(path, headers=BEARER)
            assert (answer.status_code, answer.headers["cache-control"]) == (200, "no-store")
            return dict(answer.json())

        listed = await read("/api/vehicles")
        assert [each["system_id"] for each in listed["vehicles"]] == [1]  # type: ignore[attr-defined]
        vehicle = await read("/api/vehicles/1")
        assert vehicle["states"]["armed"]["value"] is False  # type: ignore[index]
        assert "range_finders" not in vehicle["states"]  # type: ignore[operator]
        assert "GUIDED" in vehicle["modes"]  # type: ignore[operator]
        assert [each["name"] for each in (await read("/api/vehicles/1/mission"))["items"]] == ["NAV_TAKEOFF"]  # type: ignore[attr-defined]
        await anyio.sleep(5)
        assert (await read("/api/vehicles/1/mission"))["age_s"] == pytest.approx(5, abs=0.5)
        assert len((await read("/api/vehicles/1/parameters"))["parameters"]) > 1000  # type: ignore[arg-type]
        texts = (await read("/api/vehicles/1/texts"))["texts"]
        assert "<b>hello</b>" in [each["text"] for each in texts]  # type: ignore[attr-defined]
        events = (await read("/api/events"))["events"]
        assert any(each["event"] == "StatusTextReceived" for each in events)  # type: ignore[attr-defined]


async def test_mission_with_changed_count_is_downloaded_again() -> None:
    async with open_stage() as stage:
        mission = stage.flight.vehicle.mission

        async def names() -> list[str]:
            answer = await stage.client.get("/api/vehicles/1/mission", headers=BEARER)
            return [each["name"] for each in answer.json()["items"]]

        await mission.upload(Mission([take_off(altitude_relative_m=10)]))
        assert await names() == ["NAV_TAKEOFF"]
        await mission.upload(Mission([take_off(altitude_relative_m=10), return_to_launch()]))
        await anyio.sleep(3)
        assert await names() == ["NAV_TAKEOFF", "NAV_RETURN_TO_LAUNCH"]


async def test_mission_of_same_length_is_downloaded_again() -> None:
    """Another program has uploaded it, whose answer from the vehicle arrives on a shared link."""
    async with open_stage() as stage:
        mission, copter = stage.flight.vehicle.mission, stage.flight.copter

        async def names() -> list[str]:
            answer = await stage.client.get("/api/vehicles/1/mission", headers=BEARER)
            return [each["name"] for each in answer.json()["items"]]

        await mission.upload(Mission([take_off(altitude_relative_m=10)]))
        assert await names() == ["NAV_TAKEOFF"]
        copter.missions.replace(0, Mission([return_to_launch()]).to_items(home_is_item_0=True))
        assert await names() == ["NAV_TAKEOFF"]
        stage.flight.wire.deliver(FrameEncoder(1, 1).encode(MissionAck(254, 190, MavMissionResult.ACCEPTED)))
        assert await names() == ["NAV_RETURN_TO_LAUNCH"]


@pytest.mark.parametrize("is_open", [True, False])
async def test_reading_needs_token_unless_open(is_open: bool) -> None:
    async with open_stage(open_reading=is_open) as stage:
        paths = [
            route.path for route in stage.app.routes if isinstance(route, Route) and "GET" in (route.methods or ())
        ]
        vehicles = [path for path in paths if path.startswith("/api/") and not path.endswith("openapi.json")]
        assert len(vehicles) == 12
        for path in vehicles:
            asked = path.format(system_id=1, name="RTL_ALT", key="12345678")
            answer = await stage.client.get(asked)
            assert (answer.status_code == 401) is not is_open
        wrong = await stage.client.get("/api/vehicles", headers={"Authorization": "Bearer wrong"})
        refresh = await stage.client.get("/api/vehicles/1/mission?refresh=true")
        assert (wrong.status_code, refresh.status_code) == (401, 401)


async def test_openapi_document_matches_routes() -> None:
    async with open_stage() as stage:
        document = (await stage.client.get("/api/openapi.json")).json()
        assert document["openapi"] == "3.1.0"
        documented = {(method.upper(), path) for path, item in document["paths"].items() for method in item}
        routes = {
            (method, route.path)
            for route in stage.app.routes
            if isinstance(route, Route) and route.path.startswith("/api")
            for method in (route.methods or set()) - {"HEAD"}
        }
        streams = {("GET", route.path) for route in stage.app.routes if isinstance(route, WebSocketRoute)}
        assert documented == routes | streams
        check_shape(document)


def check_shape(document: dict[str, object]) -> None:
    """Check the document against OpenAPI 3.1: required fields, references, path parameters."""
    names = []
    for path, item in document["paths"].items():  # type: ignore[attr-defined]
        for operation in item.values():
            names.append(operation["operationId"])
            declared = {each["name"] for each in operation["parameters"] if each["in"] == "path"}
            assert declared == set(re.findall(r"{(\w+)}", path))
            assert all(each["schema"] and each["in"] in ("path", "query", "header") for each in operation["parameters"])
            assert operation["responses"]
            assert all(each["description"] for each in operation["responses"].values())
            if "requestBody" in operation:
                schema = operation["requestBody"]["content"]["application/json"]["schema"]
                assert set(schema["required"]) <= set(schema["properties"])
    assert len(names) == len(set(names))
    schemas = document["components"]["schemas"]  # type: ignore[index]
    assert set(re.findall(r"#/components/schemas/(\w+)", str(document))) == set(schemas)
    assert set(document) == {"openapi", "info", "servers", "paths", "components"}


async def test_page_loads_no_external_resources() -> None:
    async with open_stage() as stage:
        page = await stage.client.get("/")
        assert page.headers["content-type"].startswith("text/html")
        assert "img-src 'self';" in page.headers["content-security-policy"]
        for name in re.findall(r"static/[\w./]+", page.text):
            assert (await stage.client.get(f"/{name}")).status_code == 200
        for path in ("/static/../app.py", "/static/%2e%2e/app.py", "/static/", "/app.py"):
            assert (await stage.client.get(path)).status_code == 404


def test_scripts_never_set_html() -> None:
    scripts = [path.read_text() for path in sorted(Path(STATIC).glob("*.js"))]
    assert len(scripts) >= 8
    for script in scripts:
        assert not re.search(r"\.(innerHTML|outerHTML|insertAdjacentHTML)|document\.write|eval\(|https?://", script)


async def test_content_policy_allows_tile_origin_only() -> None:
    async with open_stage(tiles="https://tiles.example:8443/a/{z}/{x}/{y}.png") as stage:
        policy = (await stage.client.get("/")).headers["content-security-policy"]
        assert "img-src 'self' https://tiles.example:8443 data:;" in policy
        for wrong in (
            "tiles.example/{z}",
            "https://t/{z}/{x}.png",
            "https://t/{z}/{x}/{y};x",
            "javascript:{z}{x}{y}",
        ):
            with pytest.raises(InvalidArgument, match="tiles"):
                make_app(stage.flight.vehicle, token=TOKEN, tiles=wrong)


async def test_mounted_app_serves_all_vehicles() -> None:
    copters = [SimulatedCopter(system_id=number, boot_time_s=0.0) for number in (3, 7)]
    async with simulated_link(copters) as link, aerokit.open_connection(link) as connection:
        async with make_app(connection, token=TOKEN) as app:
            await anyio.sleep(2)
            host = Starlette(routes=[Mount("/drones", app)])
            transport = httpx.ASGITransport(host)
            async with httpx.AsyncClient(transport=transport, base_url=f"http://{HOST}") as client:
                answer = await client.get("/drones/api/vehicles", headers=BEARER)
                assert [each["system_id"] for each in answer.json()["vehicles"]] == [3, 7]
                assert (await client.get("/drones/")).status_code == 200
                document = (await client.get("/drones/api/openapi.json")).json()
                assert document["servers"] == [{"url": "/drones"}]
        assert connection.is_open


# ------------------------------------------------------------------------------------------- stream


async def test_stream_sends_state_events_and_commands() -> None:
    async with open_stage() as stage, Socket(stage.app, query="rate_hz=2", origin=f"http://{HOST}") as socket:
        assert (await socket.next("websocket.accept"))["subprotocol"] == "aerokit.v1"
        assert (await socket.next("hello"))["read_only"] is False
        first, second = await socket.next("state"), await socket.next("state")
        assert second["at_s"] - first["at_s"] == pytest.approx(0.5, abs=0.05)
        await stage.submit("arm")
        assert (await socket.next("order"))["state"] == "running"
        assert (await socket.next("order"))["state"] == "done"
        stage.flight.copter.send_text(4, "hello")
        events = await socket.next("event")
        while events["event"] != "StatusTextReceived" or events["text"] != "hello":
            events = await socket.next("event")


@pytest.mark.parametrize(
    ("change", "status"),
    [
        ({"token": "wrong-token-wrong-token"}, 401),
        ({"token": None}, 401),
        ({"query": "rate_hz=1000"}, 400),
        ({"query": "rate_hz=nan"}, 400),
        ({"origin": "http://evil.example"}, None),
        ({"host": "evil.example"}, None),
    ],
)
async def test_websocket_without_access_is_refused(change: dict[str, str], status: int | None) -> None:
    async with open_stage() as stage, Socket(stage.app, **change) as socket:  # type: ignore[arg-type]
        if status is None:
            assert (await socket.next("websocket.close"))["code"] == 1008
        else:
            assert (await socket.next("websocket.http.response.start"))["status"] == status


async def test_websocket_count_is_limited() -> None:
    async with open_stage() as stage:
        sockets = [Socket(stage.app) for _ in range(MAX_SOCKETS)]
        for each in sockets:
            await each.__aenter__()
            await each.next("websocket.accept")
        async with Socket(stage.app) as one_more:
            assert (await one_more.next("websocket.http.response.start"))["status"] == 503
        for each in sockets:
            await each.__aexit__()
        async with Socket(stage.app) as later:
            await later.next("websocket.accept")


async def test_anonymous_websockets_leave_room_for_token_holder() -> None:
    async with open_stage(open_reading=True) as stage, AsyncExitStack() as stack:
        for _ in range(MAX_ANONYMOUS_SOCKETS):
            viewer = await stack.enter_async_context(Socket(stage.app, token=None))
            await viewer.next("websocket.accept")
        async with Socket(stage.app, token=None) as one_more:
            assert (await one_more.next("websocket.http.response.start"))["status"] == 503
        async with Socket(stage.app) as owner:
            await owner.next("websocket.accept")


async def test_slow_client_gets_newest_state_and_stalled_is_closed() -> None:
    async with open_stage() as stage, Socket(stage.app) as socket:
        before = (await socket.next("state"))["at_s"]
        socket.flows.clear()
        for number in range(MAX_QUEUED_MESSAGES + 50):
            stage.app._served.publish({"type": "event", "event": "Test", "index": number})
        await anyio.sleep(8)
        socket.flows.set()
        states = [await socket.next("state") for _ in range(3)]
        assert states[1]["at_s"] - before >= 8  # the queued state, then the newest one; the 40 between are skipped
        socket.flows.clear()
        await anyio.sleep(30)
        assert socket.task.done()


class SlowSocket(Socket):
    """Takes a message every 10 ms, while a new event is published."""

    async def _take(self, message: object) -> None:
        await anyio.sleep(0.01)
        self.app._served.publish({"type": "event", "event": "Test"})
        await super()._take(message)


async def test_stream_of_slow_client_has_states_among_many_events() -> None:
    async with open_stage() as stage, SlowSocket(stage.app, query="rate_hz=5") as socket:
        with anyio.fail_after(2):
            for _ in range(5):
                await socket.next("state")


async def test_failed_stream_is_logged_and_closed(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with open_stage() as stage, Socket(stage.app) as socket:
        await socket.next("state")
        monkeypatch.setattr(stage.app._served, "snapshot", lambda: json.dumps(object()))
        assert (await socket.next("websocket.close"))["code"] == 1011
    assert "the stream of states has failed" in caplog.text
    assert "is not JSON serializable" in caplog.text


@pytest.mark.parametrize("offset_s", [-1e-10, 1e-10])
async def test_cancellation_as_next_state_is_due_ends_stream(offset_s: float) -> None:
    # On Python 3.10 a scope of anyio loses a cancellation in the iteration of the loop in which its deadline passes.
    async with open_stage() as stage:
        loop, period_s = asyncio.get_running_loop(), 1.0
        access = AccessControl(TOKEN, open_reading=False, read_only=False)
        stream = StateStream(stage.app._served, stage.app._orders, access)
        sending = asyncio.create_task(stream._send_messages(AsyncMock(), period_s))
        loop.call_at(loop.time() + period_s + offset_s, sending.cancel)
        await anyio.sleep(2.5 * period_s)
        assert sending.cancelled()


async def test_client_that_sends_is_disconnected() -> None:
    async with open_stage() as stage, Socket(stage.app) as socket:
        await socket.next("state")
        socket.incoming.put_nowait({"type": "websocket.receive", "text": '{"order": "arm"}'})
        assert (await socket.next("websocket.close"))["code"] == 1008


# ------------------------------------------------------------------------------------------- for the page


async def test_track_covers_flight_within_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("aerokit.apps.serve.served_vehicles.MAX_TRACK_POINTS", 20)
    async with open_stage() as stage:
        vehicle = stage.flight.vehicle
        start = vehicle.position.value
        await vehicle.arm()
        await vehicle.take_off(10)
        await vehicle.go_to(vehicle.position.value.offset(north_m=80), speed_m_s=5)
        points = (await stage.client.get("/api/vehicles/1/track", headers=BEARER)).json()["points"]
        assert 10 <= len(points) <= 20
        assert not any(is_after_gap for *_, is_after_gap in points[1:])
        assert points[0][:2] == pytest.approx((start.latitude_deg, start.longitude_deg), abs=1e-6)
        end = vehicle.position.value
        assert points[-1][:2] == pytest.approx((end.latitude_deg, end.longitude_deg), abs=2e-5)


def test_full_track_keeps_marks_of_gaps() -> None:
    here = Position(47.0, 8.0)
    track = [_TrackPoint(here.offset(north_m=index), is_after_gap=index in (4, 7)) for index in range(8)]
    _thin_out(track)
    assert [(round(position.distance_to(here)), is_after_gap) for position, is_after_gap in track] == [
        (0, False),
        (1, False),
        (3, False),
        (5, True),
        (7, True),
    ]


async def test_failed_background_task_is_logged(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("aerokit.apps.serve.served_vehicles.TRACK_GAP_S", None)
    async with open_stage():
        await anyio.sleep(1)
    assert "a task of aerokit serve has failed" in caplog.text


async def test_track_marks_gap_after_silence() -> None:
    async with open_stage() as stage:
        vehicle = stage.flight.vehicle
        await vehicle.arm()
        await vehicle.take_off(10)
        await vehicle.go_to(vehicle.position.value.offset(north_m=80))
        await vehicle.set_mode("RTL")
        await anyio.sleep(4)
        stage.flight.copter.faults.silent = True
        await anyio.sleep(6)
        stage.flight.copter.faults.silent = False
        await anyio.sleep(4)
        points = (await stage.client.get("/api/vehicles/1/track", headers=BEARER)).json()["points"]
        assert [is_after_gap for *_, is_after_gap in points[1:]].count(True) == 1


async def test_fence_and_rally_points_are_read() -> None:
    async with open_stage() as stage:
        vehicle = stage.flight.vehicle
        here = vehicle.position.value
        await vehicle.fence.upload(Fence(circles=[FenceCircle(here, 80.0)]))
        await vehicle.rally.upload(RallyPoints([rally_point(here, altitude_relative_m=30)]))
        fence = (await stage.client.get("/api/vehicles/1/fence", headers=BEARER)).json()
        rally = (await stage.client.get("/api/vehicles/1/rally", headers=BEARER)).json()
        assert [(each["radius_m"], each["inclusion"]) for each in fence["circles"]] == [(80.0, True)]
        assert [each["position"]["latitude_deg"] for each in rally["items"]] == [pytest.approx(here.latitude_deg)]


async def test_state_has_reasons_against_flight_and_failsafe() -> None:
    async with open_stage() as stage, Socket(stage.app, query="rate_hz=2") as socket:
        before = (await socket.next("state"))["vehicles"][0]
        assert (before["missing_for_flight"], before["not_armable"]) == ([], [])
        assert (before["crash"], before["disarming"], before["unread"]) == (None, None, ["DISARM_DELAY"])
        assert before["failsafe"] == {"action": None, "because": None, "unread": ["FS_GCS_ENABLE"]}
        await stage.client.get("/api/vehicles/1/parameters/FS_GCS_ENABLE", headers=BEARER)
        stage.flight.copter.faults.prearm_failures = ["Compass not healthy"]
        await anyio.sleep(40)
        socket.sent.clear()
        after = (await socket.next("state"))["vehicles"][0]
        assert after["missing_for_flight"][0] == "Compass not healthy"
        assert after["not_armable"] == ["Compass not healthy"], "the general reason adds nothing to it"
        assert after["failsafe"]["because"] == "FS_GCS_ENABLE = 0"


async def test_state_separates_not_armable_from_not_ready_to_fly() -> None:
    async with open_stage() as stage:

        def state() -> dict[str, object]:
            return dict(json.loads(stage.app._served.snapshot())["vehicles"][0])

        await stage.flight.vehicle.set_mode("STABILIZE")
        stage.flight.copter.faults.gps_lost = True
        await anyio.sleep(15)
        assert state()["missing_for_flight"] != []
        assert state()["not_armable"] == []
        assert (await stage.submit("arm")).status_code == 200
        await stage.submit("disarm")
        await stage.flight.vehicle.set_mode("LAND")
        await anyio.sleep(1)
        text = "ArduCopter needs a position to arm in GUIDED, to which arming would change the mode"
        assert state()["not_armable"][0] == text  # type: ignore[index]
        found = readiness(stage.flight.vehicle, changes_mode=True)
        assert found.against_arming == tuple(state()["not_armable"])  # type: ignore[arg-type]
        assert (await stage.submit("arm")).status_code == 409


async def test_solved_reason_is_not_listed_when_checks_pass() -> None:
    async with open_stage() as stage:
        vehicle, faults = stage.flight.vehicle, stage.flight.copter.faults
        await vehicle.set_mode("STABILIZE")
        faults.prearm_failures = ["AHRS: Not healthy"]
        await vehicle.sensors.wait_until(lambda sensors: sensors.prearm_checks_pass is False)
        await anyio.sleep(2)
        missing = json.loads(stage.app._served.snapshot())["vehicles"][0]["missing_for_flight"]
        assert missing[0] == "AHRS: Not healthy"
        faults.prearm_failures, faults.gps_lost = [], True
        await vehicle.estimator.wait_until(lambda estimator: bool(estimator.missing))
        assert vehicle.sensors.value.prearm_checks_pass is True
        missing = json.loads(stage.app._served.snapshot())["vehicles"][0]["missing_for_flight"]
        assert missing
        assert "AHRS: Not healthy" not in missing


@pytest.mark.parametrize(
    ("kind", "values", "action"),
    [
        (SimulatedCopter, {"FS_GCS_ENABLE": 2}, "returns to launch"),
        (SimulatedCopter, {"FS_GCS_ENABLE": 5}, "lands"),
        (SimulatedPlane, {"FS_GCS_ENABL": 0}, "continues: the failsafe is off"),
        (SimulatedPlane, {"FS_GCS_ENABL": 1, "FS_LONG_ACTN": 1}, "returns to launch"),
        (SimulatedRover, {"FS_GCS_ENABLE": 1, "FS_ACTION": 2}, "holds"),
        (SimulatedPx4, {"NAV_DLL_ACT": 2}, "returns to launch"),
    ],
)
async def test_failsafe_is_named_from_parameters(
    kind: type[SimulatedCopter], values: dict[str, float], action: str
) -> None:
    async with simulated_link([kind(boot_time_s=0.0)]) as link, aerokit.connect(link) as vehicle:
        assert ground_station_failsafe(vehicle)["action"] is None
        for name, value in values.items():
            await vehicle.parameters.set(name, value)
        assert ground_station_failsafe(vehicle)["action"] == action


async def test_recording_has_parameters_that_were_read(tmp_path: Path) -> None:
    """A report reads PARAM_VALUE, so MAVFTP is not used during a recording."""
    path = tmp_path / "flight.tlog"
    async with open_stage() as stage:
        stage.flight.vehicle.connection.record(path)
        answer = await stage.client.get("/api/vehicles/1/parameters", headers=BEARER)
        assert len(answer.json()["parameters"]) == len(stage.flight.copter.parameters)
    frames = Framer().receive(b"".join(raw for _, raw in read_tlog(path)), 0.0)
    recorded = {ParamValue.decode_body(frame.body).param_id for frame in frames if frame.message_id == ParamValue.ID}
    assert recorded >= set(stage.flight.copter.parameters)


async def test_parameters_have_metadata(tmp_path: Path) -> None:
    path = tmp_path / "apm.pdef.json"
    fields = {
        "DisplayName": "RTL altitude",
        "Description": "<b>How high</b>",
        "Units": "cm",
        "Range": {"low": "200", "high": "8000"},
    }
    path.write_text(json.dumps({"": {"RTL_ALT": fields}}))
    async with open_stage(metadata=load_metadata(path)) as stage:
        answer = await stage.client.get("/api/vehicles/1/parameters", headers=BEARER)
        rows = {each["name"]: each for each in answer.json()["parameters"]}
        found = rows["RTL_ALT"]
        assert (found["unit"], found["minimum"], found["maximum"]) == ("cm", 200, 8000)
        assert (found["short_description"], found["description"]) == ("RTL altitude", "<b>How high</b>")
        assert "unit" not in rows["RTL_SPEED"]


async def test_state_names_unarmable_mode_and_running_mission() -> None:
    async with open_stage() as stage, Socket(stage.app) as socket:

        async def state() -> tuple[object, object]:
            await anyio.sleep(1.5)
            socket.sent.clear()
            await socket.next("state")
            found = (await socket.next("state"))["vehicles"][0]
            return found["unarmable_mode"], found["is_flying_mission"]

        assert await state() == (None, False)
        await stage.flight.vehicle.mission.upload(Mission([take_off(altitude_relative_m=10)]))
        await stage.submit("mode", {"mode": "LAND"})
        assert await state() == ({"mode": "LAND", "arms_in": "GUIDED", "unless": None}, False)
        await stage.submit("mode", {"mode": "AUTO"})
        assert (await state())[0] == {"mode": "AUTO", "arms_in": "GUIDED", "unless": "AUTO_OPTIONS"}
        await stage.submit("mode", {"mode": "GUIDED"})
        await stage.submit("arm")
        assert (await stage.submit("mission/start")).status_code == 200
        assert (await state())[1] is True
        await stage.submit("mission/pause")
        assert (await state())[1] is False


async def test_failing_checks_are_requested_once_per_change() -> None:
    async with open_flight() as flight:
        await flight.vehicle.wait_ready()
        flight.copter.faults.prearm_failures.append("Compass not healthy")
        await flight.vehicle.sensors.wait_until(lambda sensors: sensors.prearm_checks_pass is False)
        flight.wire.clear()
        async with make_app(flight.vehicle, token=TOKEN) as app, Socket(app) as socket:

            async def missing() -> list[str]:
                socket.sent.clear()
                await socket.next("state")
                return list((await socket.next("state"))["vehicles"][0]["missing_for_flight"])

            await anyio.sleep(2)
            assert "Compass not healthy" in await missing()
            await anyio.sleep(20)
            assert len(flight.wire.commands(MavCmd.RUN_PREARM_CHECKS)) == 1
            flight.copter.faults.prearm_failures.clear()
            await flight.vehicle.sensors.wait_until(lambda sensors: sensors.prearm_checks_pass is True)
            flight.copter.faults.prearm_failures.append("Gyros inconsistent")
            await flight.vehicle.sensors.wait_until(lambda sensors: sensors.prearm_checks_pass is False)
            await anyio.sleep(2)
            reasons = await missing()
            assert "Gyros inconsistent" in reasons
            assert "Compass not healthy" not in reasons
            assert len(flight.wire.commands(MavCmd.RUN_PREARM_CHECKS)) == 2


@pytest.mark.parametrize(
    ("vehicle", "altitude_m"),
    [
        (SimulatedCopter(boot_time_s=0.0, parameters={"RTL_ALT": 2250.0}), 22.5),
        (SimulatedPlane(boot_time_s=0.0, parameters={"RTL_ALTITUDE": 90.0}), 90.0),
        (SimulatedPx4(boot_time_s=0.0, parameters={"RTL_RETURN_ALT": 40.0}), 40.0),
        (SimulatedRover(boot_time_s=0.0), None),
    ],
)
async def test_state_has_return_altitude_of_vehicle(vehicle: SimulatedVehicle, altitude_m: float | None) -> None:
    async with simulated_link(vehicle) as link, aerokit.connect(link) as connected, make_app(connected) as app:
        await anyio.sleep(5)
        assert json.loads(app._served.snapshot())["vehicles"][0]["return_altitude_m"] == altitude_m


async def test_modes_omit_what_px4_does_not_offer() -> None:
    async with (
        simulated_link(SimulatedPx4(boot_time_s=0.0)) as link,
        aerokit.connect(link) as vehicle,
        make_app(vehicle, token=TOKEN) as app,
        httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url=f"http://{HOST}") as client,
    ):
        vehicle.telemetry.receive(AvailableModes(2, 1, 0, px4_custom_mode(4, 11), 0, "Arrive"))
        modes = (await client.get("/api/vehicles/1", headers=BEARER)).json()["modes"]
    assert {"LOITER", "OFFBOARD", "Arrive"} < set(modes)
    assert not {"RATTITUDE", "EXTERNAL1", "EXTERNAL8"} & set(modes)
