"""Orders over HTTP: results, idempotency, outdated state, unknown vehicles, tokens."""

from __future__ import annotations

import asyncio
import json
from typing import Any

import anyio
import anyio.lowlevel
import httpx
import pytest
from flight_harness import open_flight, suspend_computer
from serve_stage import HOST, TOKEN, Stage, open_stage

import aerokit
from aerokit.apps.serve import make_app
from aerokit.apps.serve.api import _REFUSAL_TIMEOUT_S
from aerokit.apps.serve.orders import ORDERS
from aerokit.apps.serve.requests import MAX_BODY_SIZE, MAX_PLAN_SIZE
from aerokit.errors import InvalidArgument
from aerokit.mavlink.enums import MavCmd, MavLandedState, MavResult
from aerokit.mavlink.messages import FileTransferProtocol, MissionCount, ParamSet
from aerokit.missions import Fence, FencePolygon, Mission, Plan, format_plan, take_off, waypoint
from aerokit.parameters import Metadata, ParameterMetadata
from aerokit.position import Position
from aerokit.sim import SimulatedSub, simulated_link

pytestmark = pytest.mark.anyio
BEARER = {"Authorization": f"Bearer {TOKEN}"}


async def test_commands_fly_vehicle() -> None:
    async with open_stage() as stage:
        answers = [
            await stage.submit("mode", {"mode": "guided"}),
            await stage.submit("arm"),
            await stage.submit("take_off", {"altitude_m": 10}),
        ]
        here = stage.flight.vehicle.position.value.offset(north_m=15)
        place = {"latitude_deg": here.latitude_deg, "longitude_deg": here.longitude_deg}
        answers += [
            await stage.submit("go_to", place),
            await stage.submit("hold"),
            await stage.submit("land"),
        ]
        assert [(each.status_code, each.json()["state"]) for each in answers] == [(200, "done")] * 6
        assert stage.flight.vehicle.position.value.distance_to(here) < 3


@pytest.mark.parametrize("is_open", [False, True])
async def test_command_without_token_is_refused(is_open: bool) -> None:
    async with open_stage(open_reading=is_open) as stage:
        stage.flight.wire.clear()
        wrong = [None, "Bearer ", f"Bearer {TOKEN}x", f"Basic {TOKEN}", "Bearer ä"]
        for authorization in wrong:
            headers = {b"Idempotency-Key": b"12345678"}
            if authorization is not None:
                headers[b"Authorization"] = authorization.encode()
            for path in [f"/api/vehicles/1/{each.name}" for each in ORDERS]:
                answer = await stage.client.post(path, headers=headers)
                assert answer.status_code == 401
                assert answer.headers["content-type"] == "application/problem+json"
            answer = await stage.client.put("/api/vehicles/1/parameters/RTL_ALT", json={"value": 1}, headers=headers)
            assert answer.status_code == 401
            refresh = await stage.client.get("/api/vehicles/1/mission?refresh=true", headers=headers)
            assert refresh.status_code == 401, "it costs the vehicle's link something"
        assert stage.flight.wire.sent == []


@pytest.mark.parametrize(
    ("order", "body", "text"),
    [
        ("take_off", {}, "altitude_m is missing"),
        ("take_off", {"altitude_m": "high"}, "a number"),
        ("take_off", {"altitude_m": -3}, "altitude_m = -3"),
        ("take_off", {"altitude_m": 5, "force": True}, "unknown argument"),
        ("go_to", {"latitude_deg": 95, "longitude_deg": 0}, "latitude"),
        (
            "go_to",
            {"latitude_deg": -35, "longitude_deg": 149, "altitude_relative_m": -20},
            "must be 0 or more",
        ),
        (
            "go_to",
            {"latitude_deg": -35, "longitude_deg": 149, "altitude_relative_m": -(10**400)},
            "must be 0 or more",
        ),
        ("mode", {"mode": "GIUDED"}, "did you mean 'GUIDED'"),
        ("mode", {"mode": True}, "mode = True is no"),
        ("mission/start", {"item": -1}, "item"),
        ("mission/start", {"item": True}, "item = True is not allowed: its type must be integer"),
        ("arm", ["x"], "not a JSON object"),
    ],
)
async def test_invalid_arguments_send_nothing(order: str, body: object, text: str) -> None:
    async with open_stage() as stage:
        stage.flight.wire.clear()
        answer = await stage.submit(order, body)
        assert (answer.status_code, answer.json()["status"]) == (400, 400)
        assert text in answer.json()["detail"]
        assert stage.flight.wire.mode_orders() == []
        for command in (MavCmd.NAV_TAKEOFF, MavCmd.DO_REPOSITION, MavCmd.COMPONENT_ARM_DISARM):
            assert stage.flight.wire.commands(command) == []


@pytest.mark.parametrize(
    ("content", "headers", "status"),
    [
        (b"{", {}, 400),
        (b'{"altitude_m": NaN}', {}, 400),
        (b'{"altitude_m": 1, "altitude_m": 90}', {}, 400),
        (b"[" * 16_000, {}, 400),
        (b"\xff\xfe", {}, 400),
        (b"x" * 20_000, {}, 413),
        (b'{"altitude_m": 10}', {"Content-Type": "text/plain"}, 415),
        (b'{"altitude_m": 10}', {"Idempotency-Key": ""}, 400),
        (b'{"altitude_m": 10}', {"Idempotency-Key": "short"}, 400),
        (b'{"altitude_m": 10}', {"Aerokit-Seen-At": "nan"}, 400),
        (b'{"altitude_m": 10}', {"Aerokit-Seen-At": "-100"}, 409),
        (b'{"altitude_m": 10}', {"Host": "evil.example"}, 421),
        (b'{"altitude_m": 10}', {"Origin": "http://evil.example"}, 403),
        (b'{"altitude_m": 10}', {"Origin": "http://["}, 403),
        (b'{"altitude_m": 10}', {"Origin": "null"}, 403),
        (b'{"altitude_m": 10}', {"Origin": "http://127.0.0.1:9090"}, 403),
        (b'{"altitude_m": 10}', {"Sec-Fetch-Site": "cross-site"}, 403),
    ],
)
async def test_hostile_requests_are_refused(content: bytes, headers: dict[str, str], status: int) -> None:
    async with open_stage() as stage:
        usual = {**BEARER, "Content-Type": "application/json", "Idempotency-Key": "12345678", "Host": HOST}
        answer = await stage.client.post("/api/vehicles/1/take_off", content=content, headers={**usual, **headers})
        assert answer.status_code == status
        assert "default-src 'none'" in answer.headers["content-security-policy"]
        assert "access-control-allow-origin" not in answer.headers
        assert stage.flight.wire.commands(MavCmd.NAV_TAKEOFF) == []


@pytest.mark.parametrize("seen_at", ["-100", "1e9"])
async def test_state_of_another_time_is_refused_without_claiming_its_age(seen_at: str) -> None:
    """An ``at_s`` in the future is that of another server, so it is not older than any limit."""
    async with open_stage() as stage:
        headers = {**BEARER, "Idempotency-Key": "12345678", "Host": HOST, "Aerokit-Seen-At": seen_at}
        answer = await stage.client.post("/api/vehicles/1/take_off", json={"altitude_m": 10}, headers=headers)
        assert answer.status_code == 409
        assert "the client's state of the vehicle is not from the last 5 s; nothing was sent" in answer.text


@pytest.mark.parametrize(
    ("order", "content"),
    [
        ("take_off", b'{"altitude_m": 1e999}'),
        ("mode", b'{"mode": "\\ud800"}'),
        ("mode", b'{"mode": "x\\udfff"}'),
    ],
)
async def test_values_beyond_json_are_refused(order: str, content: bytes) -> None:
    """Otherwise the list of orders and the stream would fail for every client."""
    async with open_stage() as stage:
        headers = {**BEARER, "Content-Type": "application/json", "Idempotency-Key": "12345678"}
        answer = await stage.client.post(f"/api/vehicles/1/{order}", content=content, headers=headers)
        assert answer.status_code == 400
        listed = await stage.client.get("/api/orders", headers=BEARER)
        assert (listed.status_code, listed.json()) == (200, {"orders": []})


async def test_order_based_on_state_from_before_sleep_is_refused() -> None:
    async with open_stage() as stage:
        seen_at = str(asyncio.get_running_loop().time())
        accepted = await stage.submit("mode", {"mode": "GUIDED"}, Aerokit_Seen_At=seen_at)
        await asyncio.sleep(0.5)
        suspend_computer(stage.flight.vehicle, 600.0)
        refused = await stage.submit("arm", Aerokit_Seen_At=seen_at)
        assert (accepted.status_code, refused.status_code, refused.json()["error"]) == (200, 409, "Late")
        assert not stage.flight.wire.commands(MavCmd.COMPONENT_ARM_DISARM)


async def test_unknown_vehicle_id_is_refused() -> None:
    async with open_stage() as stage:
        for name in ("2", "0", "256", "-1", "1.0", "٣", "one"):
            answer = await stage.client.post(
                f"/api/vehicles/{name}/arm",
                headers={**BEARER, "Idempotency-Key": f"key-{len(name)}-{name!a}"},
            )
            assert answer.status_code == 404
        assert stage.flight.wire.commands(MavCmd.COMPONENT_ARM_DISARM) == []


async def test_repeated_key_sends_command_once() -> None:
    async with open_stage() as stage:
        answers = [await stage.submit("arm", Idempotency_Key="the-same-key") for _ in range(3)]
        assert [each.json()["state"] for each in answers] == ["done"] * 3
        assert len(stage.flight.wire.commands(MavCmd.COMPONENT_ARM_DISARM)) == 1
        other = await stage.submit("disarm", Idempotency_Key="the-same-key")
        assert (other.status_code, other.json()["error"]) == (409, "KeyUsed")
        assert stage.flight.copter.is_armed


async def test_repeated_key_after_result_expiry_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("aerokit.apps.serve.orders.MAX_RESULTS", 3)
    async with open_stage() as stage:
        await stage.submit("arm", Idempotency_Key="the-same-key")
        await stage.submit("disarm")
        for _ in range(4):
            await stage.submit("mode", {"mode": "NONE"})
        again = await stage.submit("arm", Idempotency_Key="the-same-key")
        assert (again.status_code, again.json()["error"]) == (409, "KeyUsed")
        assert "its result is no longer stored" in again.json()["detail"]
        assert not stage.flight.copter.is_armed


async def test_keys_are_bounded_and_single_use(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("aerokit.apps.serve.orders.MAX_RESULTS", 5)
    monkeypatch.setattr("aerokit.apps.serve.orders.MAX_USED_KEYS", 20)
    async with open_stage() as stage:
        for number in range(40):
            await stage.submit("disarm", Idempotency_Key=f"flood-{number:04}")
        orders = stage.app._orders
        assert (len(orders._records), len(orders._used_keys)) == (5, 20)
        for number in (39, 20):
            answer = await stage.submit("arm", Idempotency_Key=f"flood-{number:04}")
            assert answer.json()["error"] == "KeyUsed"
        assert not stage.flight.copter.is_armed


@pytest.mark.parametrize("offset_s", [-1e-10, 1e-10])
async def test_cancelled_request_does_not_answer(offset_s: float) -> None:
    # On Python 3.10 a scope of anyio loses a cancellation in the iteration of the loop in which its deadline passes.
    async with open_stage() as stage:
        await stage.submit("arm")
        loop = asyncio.get_running_loop()
        asking = asyncio.create_task(stage.submit("take_off?wait=false", {"altitude_m": 20}))
        loop.call_at(loop.time() + _REFUSAL_TIMEOUT_S + offset_s, asking.cancel)
        await anyio.sleep(1.0)
        assert asking.cancelled()


async def test_replaced_order_names_its_successor() -> None:
    async with open_stage() as stage:
        await stage.submit("arm")
        started = await stage.submit("take_off?wait=false", {"altitude_m": 20}, Idempotency_Key="the-take-off")
        assert started.status_code == 202
        await anyio.sleep(3)
        assert (await stage.submit("hold", Idempotency_Key="the-hold")).status_code == 200
        listed = (await stage.client.get("/api/orders", headers=BEARER)).json()["orders"]
        found = {each["key"]: (each["state"], each["replaced_by"]) for each in listed}
        assert found["the-take-off"] == ("failed", "the-hold")
        assert found["the-hold"] == ("done", None)


async def test_order_ended_by_pilot_is_not_replaced() -> None:
    async with open_stage() as stage:
        await stage.submit("arm")
        await stage.submit("take_off?wait=false", {"altitude_m": 20}, Idempotency_Key="the-take-off")
        await anyio.sleep(3)
        stage.flight.pilot_takes_over()
        await anyio.sleep(3)
        found = (await stage.client.get("/api/orders/the-take-off", headers=BEARER)).json()
        assert (found["state"], found["replaced_by"]) == ("failed", None)


async def test_submarine_goes_below_home() -> None:
    async with simulated_link([SimulatedSub(boot_time_s=0.0)]) as link, aerokit.connect(link) as vehicle:
        await vehicle.wait_ready()
        place = vehicle.position.value
        await vehicle.set_mode("GUIDED")
        await vehicle.arm()
        position = {"latitude_deg": place.latitude_deg, "longitude_deg": place.longitude_deg}
        go_to = next(each for each in ORDERS if each.name == "go_to")
        await go_to.run(vehicle, {**position, "altitude_relative_m": -3})
        assert (vehicle.position.value.altitude_relative_m or 0.0) < -1


async def test_refusal_contains_reasons() -> None:
    async with open_stage() as stage:
        stage.flight.copter.faults.refuse(MavCmd.COMPONENT_ARM_DISARM, MavResult.FAILED, "Arm: Compass not healthy")
        refused = await stage.submit("arm")
        assert (refused.status_code, refused.json()["error"]) == (409, "CommandRejected")
        assert "Arm: Compass not healthy" in refused.json()["reasons"]
        not_armed = await stage.submit("take_off", {"altitude_m": 5})
        assert (not_armed.status_code, not_armed.json()["error"]) == (409, "OperationRejected")


async def test_resume_needs_flying_vehicle() -> None:
    async with open_stage() as stage:
        vehicle = stage.flight.vehicle
        await vehicle.mission.upload(Mission([take_off(10), waypoint(vehicle.position.value.offset(north_m=500))]))
        await stage.submit("mode", {"mode": "GUIDED"})
        await stage.submit("arm")
        await vehicle.landed_state.wait_until(lambda landed: landed == MavLandedState.ON_GROUND, timeout=5.0)
        stage.flight.wire.clear()
        refused = await stage.submit("mission/resume")
        assert (refused.status_code, refused.json()["error"]) == (409, "OperationRejected")
        assert "on the ground" in refused.json()["detail"]
        assert stage.flight.wire.mode_orders() == []
        await stage.submit("take_off", {"altitude_m": 10})
        assert (await stage.submit("mission/resume")).json()["state"] == "done"
        assert vehicle.mode_name == "AUTO"


async def test_silent_vehicle_accepts_safe_commands_only() -> None:
    async with open_stage() as stage:
        stage.flight.copter.faults.silent = True
        await anyio.sleep(5)
        stage.flight.wire.clear()
        answer = await stage.submit("arm")
        assert (answer.status_code, answer.json()["error"]) == (503, "HeartbeatTimeout")
        assert stage.flight.wire.commands(MavCmd.COMPONENT_ARM_DISARM) == []
        landing = await stage.submit("land")  # what brings it to rest is tried
        assert landing.status_code in (503, 504)
        assert stage.flight.wire.mode_orders() != []


async def test_disconnected_client_does_not_cancel_command() -> None:
    async with open_stage() as stage:
        await stage.flight.take_off()
        there = stage.flight.vehicle.position.value.offset(north_m=40)
        place = {"latitude_deg": there.latitude_deg, "longitude_deg": there.longitude_deg}
        asking = asyncio.ensure_future(stage.submit("go_to", place, Idempotency_Key="gone-away"))
        await anyio.sleep(3)
        asking.cancel()
        await asyncio.wait([asking])
        await anyio.sleep(30)
        assert stage.flight.vehicle.mode_name == "GUIDED"
        assert stage.flight.vehicle.position.value.distance_to(there) < 3
        record = await stage.client.get("/api/orders/gone-away", headers=BEARER)
        assert record.json()["state"] == "done"
        assert 3 < record.json()["ended_unix_s"] - record.json()["given_unix_s"] < 33


async def test_newer_command_overrules_older_one() -> None:
    async with open_stage() as stage:
        await stage.flight.take_off()
        there = stage.flight.vehicle.position.value.offset(north_m=90)
        place = {"latitude_deg": there.latitude_deg, "longitude_deg": there.longitude_deg}
        started = await stage.submit("go_to?wait=false", place, Idempotency_Key="older-one")
        assert (started.status_code, started.json()["state"]) == (202, "running")
        held = await stage.submit("hold")
        assert (held.status_code, held.json()["result"]) == (200, {"mode": "BRAKE"})
        older = (await stage.client.get("/api/orders/older-one", headers=BEARER)).json()
        assert (older["state"], older["problem"]["status"]) == ("failed", 409)


async def test_server_shutdown_holds_vehicle() -> None:
    async with open_flight() as flight:
        await flight.take_off()
        there = flight.vehicle.position.value.offset(north_m=90)
        async with make_app(flight.vehicle, token=TOKEN) as app:
            orders = app._orders
            go_to = next(each for each in ORDERS if each.name == "go_to")
            place = {"latitude_deg": there.latitude_deg, "longitude_deg": there.longitude_deg}
            given = orders.submit(flight.vehicle, go_to, place, "12345678", None)
            await anyio.sleep(3)
        assert given.state == "failed"
        await anyio.sleep(3)
        assert flight.vehicle.mode_name == "BRAKE"


@pytest.mark.parametrize(("name", "text"), [("land", "may continue it"), ("mission/resume", "commanded to hold")])
async def test_shutdown_says_what_vehicle_does(name: str, text: str) -> None:
    async with open_flight() as flight:
        await flight.take_off()
        async with make_app(flight.vehicle, token=TOKEN) as app:
            order = next(each for each in ORDERS if each.name == name)
            record = app._orders.submit(flight.vehicle, order, {}, "12345678", None)
            await anyio.lowlevel.checkpoint()
        assert record.problem is not None
        assert text in record.problem["detail"]


async def test_order_after_shutdown_is_refused() -> None:
    async with open_stage() as stage:
        await stage.app.aclose()
        with anyio.fail_after(5):
            refused = await stage.submit("hold")
        assert (refused.status_code, refused.json()["error"]) == (503, "Ended")
        assert stage.app._orders.all() == []


async def test_order_at_shutdown_ends_although_it_never_ran() -> None:
    async with open_stage() as stage:
        hold = next(each for each in ORDERS if each.name == "hold")
        record = stage.app._orders.submit(stage.flight.vehicle, hold, {}, "key-of-hold", None)
        await stage.app.aclose()
        assert record.ended.is_set()
        assert (record.state, record.problem and record.problem["error"]) == ("failed", "Ended")


async def test_read_only_server_refuses_commands() -> None:
    async with open_stage(read_only=True, open_reading=True) as stage:
        for kind in ORDERS:
            answer = await stage.submit(kind.name, {})
            assert (answer.status_code, answer.json()["error"]) == (403, "ReadOnly")
        written = await stage.client.put(
            "/api/vehicles/1/parameters/RTL_ALT",
            json={"value": 1},
            headers={**BEARER, "Idempotency-Key": "12345678"},
        )
        assert written.status_code == 403
        assert stage.app._orders.all() == []


async def test_set_parameter_publishes_event() -> None:
    async with open_stage() as stage:
        path, headers = "/api/vehicles/1/parameters/WPNAV_SPEED", {**BEARER, "Idempotency-Key": "set-it-now"}
        written = await stage.client.put(path, json={"value": 800}, headers=headers)
        assert (written.status_code, written.json()["result"]["value"]) == (200, 800)
        assert (await stage.client.get(path, headers=BEARER)).json()["value"] == 800
        missing = await stage.client.get("/api/vehicles/1/parameters/NO_SUCH", headers=BEARER)
        assert missing.status_code == 404


@pytest.mark.parametrize("token", ["short", "x" * 300, "with space in the middle", "ümlaut-in-the-token-here"])
async def test_invalid_token_raises(token: str) -> None:
    async with open_flight() as flight:
        with pytest.raises(InvalidArgument, match="token"):
            make_app(flight.vehicle, token=token)


def plan_of(items: int, *, fence: bool = False) -> dict[str, Any]:
    here = Position(-35.363261, 149.165230)
    corners = [here.offset(north_m=n, east_m=e) for n, e in ((90, -90), (90, 90), (-90, 0))]
    legs = [waypoint(at.latitude_deg, at.longitude_deg, altitude_relative_m=15) for at in corners]
    mission = Mission([take_off(altitude_relative_m=15), *legs * items][:items])
    plan = Plan(mission, Fence([FencePolygon(corners)] if fence else []))
    return dict(json.loads(format_plan(plan)))


async def test_upload_replaces_mission_and_keeps_fence_that_plan_lacks() -> None:
    async with open_stage() as stage:
        first = await stage.submit("mission/upload", {"name": "a.plan", "plan": plan_of(4, fence=True)})
        assert (first.status_code, first.json()["state"]) == (200, "done")
        shown = first.json()["arguments"]
        assert (shown["name"], shown["mission_items"], shown["fence_items"]) == ("a.plan", 4, 3)
        assert "plan" not in shown
        mission = await stage.client.get("/api/vehicles/1/mission", headers=BEARER)
        assert len(mission.json()["items"]) == 4
        await stage.submit("mission/upload", {"plan": plan_of(3)})
        mission = await stage.client.get("/api/vehicles/1/mission", headers=BEARER)
        assert len(mission.json()["items"]) == 3
        assert len((await stage.flight.vehicle.fence.download()).polygons) == 1


async def test_upload_with_repeated_key_is_sent_once() -> None:
    async with open_stage() as stage:
        key = {"Idempotency_Key": "upload-1"}
        plan = plan_of(2)
        assert (await stage.submit("mission/upload", {"plan": plan}, **key)).status_code == 200
        stage.flight.wire.clear()
        again = await stage.submit("mission/upload", {"plan": plan}, **key)
        other = await stage.submit("mission/upload", {"plan": plan_of(3)}, **key)
        assert (again.status_code, again.json()["state"], other.status_code) == (200, "done", 409)
        assert stage.flight.wire.all(MissionCount) + stage.flight.wire.all(FileTransferProtocol) == []


METADATA = Metadata(
    [
        ParameterMetadata("RTL_ALT", unit="cm", minimum=30, maximum=300000),
        ParameterMetadata("FS_THR_ENABLE", values={0: "Disabled", 1: "Enabled"}),
    ]
)


async def set_parameter(stage: Stage, name: str, body: object) -> httpx.Response:
    stage.keys += 1
    headers = {**BEARER, "Idempotency-Key": f"set-{stage.keys:08}"}
    return await stage.client.put(f"/api/vehicles/1/parameters/{name}", json=body, headers=headers)


@pytest.mark.parametrize(
    ("name", "body", "text"),
    [
        ("RTL_ALT", {"value": -99999}, "RTL_ALT = -99999 is not in 30..300000 cm; nothing was set; "),
        ("RTL_ALT", {"value": 10**400}, "RTL_ALT"),
        ("RTL_ALT", {"value": -99999, "force": False}, "RTL_ALT = -99999 is not in 30..300000 cm; nothing was set; "),
        ("RTL_ALT", {"value": -99999, "force": 1}, "force = 1 is not allowed: its type must be boolean"),
        ("RTL_ALT", {"value": True, "force": True}, "value = True is not allowed: its type must be number"),
        ("RTL_ALT", {"value": "-99999"}, "number"),
        ("rtl_alt", {"value": 29}, "rtl_alt = 29: RTL_ALT = 29 is not in 30..300000 cm"),
        ("RTL_ALT_M", {"value": 9000}, "RTL_ALT_M = 9000: RTL_ALT = 900000 is not in 30..300000 cm"),
        ("FS_THR_ENABLE", {"value": 9}, "FS_THR_ENABLE = 9 is not a documented value: 0 Disabled, 1 Enabled"),
    ],
)
async def test_parameter_outside_metadata_is_not_sent(name: str, body: object, text: str) -> None:
    async with open_stage(metadata=METADATA) as stage:
        stage.flight.wire.clear()
        answer = await set_parameter(stage, name, body)
        assert (answer.status_code, answer.json()["error"]) == (400, "InvalidArgument")
        assert text in answer.json()["detail"]
        assert stage.flight.wire.all(ParamSet) == []
        assert stage.flight.copter.parameters["RTL_ALT"] == 1500


async def test_parameter_outside_metadata_needs_force() -> None:
    async with open_stage(metadata=METADATA) as stage:
        refused = await set_parameter(stage, "RTL_ALT", {"value": 20})
        assert refused.json()["detail"].endswith('nothing was set; "force": true sets these values nevertheless')
        assert (await set_parameter(stage, "RTL_ALT", {"value": 30})).status_code == 200
        assert stage.flight.copter.parameters["RTL_ALT"] == 30
        assert (await set_parameter(stage, "RTL_ALT", {"value": 20, "force": True})).status_code == 200
        assert stage.flight.copter.parameters["RTL_ALT"] == 20


@pytest.mark.parametrize(
    ("plan", "text"),
    [
        ({}, "fileType"),
        ({"fileType": "Plan", "version": 9}, "version"),
        (plan_of(0), "no mission items, fence or rally points"),
        ("text", "plan"),
    ],
)
async def test_invalid_plan_sends_nothing(plan: object, text: str) -> None:
    async with open_stage() as stage:
        stage.flight.wire.clear()
        answer = await stage.submit("mission/upload", {"name": "x.plan", "plan": plan})
        assert answer.status_code == 400
        assert text in answer.json()["detail"]
        assert stage.flight.wire.all(MissionCount) + stage.flight.wire.all(FileTransferProtocol) == []


async def test_large_plan_is_taken_and_too_large_one_refused() -> None:
    async with open_stage() as stage:
        plan = plan_of(90)
        answer = await stage.submit("mission/upload", {"plan": plan})
        assert len(json.dumps(plan)) > MAX_BODY_SIZE
        assert answer.status_code == 200
        assert (await stage.submit("mission/upload", {"plan": {"x": "y" * MAX_PLAN_SIZE}})).status_code == 413


async def test_plan_is_checked_in_either_format_and_nothing_is_sent() -> None:
    waypoints = "QGC WPL 110\n0\t1\t0\t16\t0\t0\t0\t0\t-35\t149\t584\t1\n1\t0\t3\t22\t0\t0\t0\t0\t0\t0\t15\t1\n"
    async with open_stage(open_reading=True) as stage:
        stage.flight.wire.clear()
        assert (await stage.client.post("/api/plan", json={"plan": waypoints})).status_code == 401
        answer = await stage.client.post("/api/plan", json={"plan": waypoints, "name": "a.waypoints"}, headers=BEARER)
        checked = answer.json()
        counts = {name: checked[name] for name in ("mission_items", "fence_areas", "rally_points")}
        assert counts == {"mission_items": 1, "fence_areas": 0, "rally_points": 0}
        assert [each["name"] for each in checked["items"]] == ["NAV_TAKEOFF"]
        assert (checked["fence"]["polygons"], checked["rally"]) == ([], [])
        broken = await stage.client.post(
            "/api/plan", json={"plan": waypoints.replace("-35", "x"), "name": "a.waypoints"}, headers=BEARER
        )
        assert (broken.status_code, broken.json()["error"]) == (400, "FileFormatError")
        assert broken.json()["detail"].startswith("a.waypoints: line 2: ")
        no_json = await stage.client.post("/api/plan", json={"plan": "no JSON", "name": "a.plan"}, headers=BEARER)
        assert (no_json.status_code, no_json.json()["error"]) == (400, "FileFormatError")
        assert no_json.json()["detail"].startswith("a.plan: ")
        assert "JSON" in no_json.json()["detail"]
        assert "QGC WPL" not in no_json.json()["detail"]
        assert not stage.flight.wire.all(MissionCount)
        uploaded = await stage.submit("mission/upload", {"plan": waypoints, "name": "a.waypoints"})
        assert uploaded.json()["arguments"]["mission_items"] == 1
        assert len(await stage.flight.vehicle.mission.download()) == 1


async def test_parameter_result_says_that_range_is_not_checked() -> None:
    async with open_stage() as stage:
        answer = await set_parameter(stage, "RTL_ALT", {"value": 2000})
        assert answer.json()["result"]["note"] == "range not checked (serve --metadata FILE checks it)"
    async with open_stage(metadata=METADATA) as stage:
        answer = await set_parameter(stage, "RTL_ALT", {"value": 2000})
        assert answer.json()["result"]["note"] == ""
