"""Orders by HTTP: awaited, given once, never late, never to another vehicle, by nobody without the token."""

from __future__ import annotations

import asyncio

import anyio
import pytest
from flight_harness import open_flight
from serve_stage import HOST, TOKEN, open_stage

from aerokit.apps.serve import make_app
from aerokit.apps.serve.orders import ORDERS
from aerokit.errors import InvalidArgument
from aerokit.mavlink.enums import MavCmd, MavResult

pytestmark = pytest.mark.anyio
BEARER = {"Authorization": f"Bearer {TOKEN}"}


async def test_a_flight() -> None:
    async with open_stage() as stage:
        answers = [
            await stage.give("mode", {"mode": "guided"}),
            await stage.give("arm"),
            await stage.give("take_off", {"altitude_m": 10}),
        ]
        here = stage.flight.vehicle.position.value.offset(north_m=15)
        place = {"latitude_deg": here.latitude_deg, "longitude_deg": here.longitude_deg}
        answers += [await stage.give("go_to", place), await stage.give("hold"), await stage.give("land")]
        assert [(each.status_code, each.json()["state"]) for each in answers] == [(200, "done")] * 6
        assert stage.flight.vehicle.position.value.distance_to(here) < 3


@pytest.mark.parametrize("is_open", [False, True])
async def test_who_gives_an_order_without_the_token_gives_none(is_open: bool) -> None:
    async with open_stage(open_reading=is_open) as stage:
        stage.flight.wire.forget()
        wrong = [None, "Bearer ", f"Bearer {TOKEN}x", f"Basic {TOKEN}", "Bearer ä"]
        for authorization in wrong:
            headers = {b"Idempotency-Key": b"12345678"}
            if authorization is not None:
                headers[b"Authorization"] = authorization.encode()
            for path in [f"/api/vehicles/1/{each.name}" for each in ORDERS]:
                answer = await stage.client.post(path, headers=headers)
                assert answer.status_code == 401
                assert answer.headers["content-type"] == "application/problem+json"
            answer = await stage.client.put(
                "/api/vehicles/1/parameters/RTL_ALT", json={"value": 1}, headers=headers
            )
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
        ("take_off", {"altitude_m": 5, "force": True}, "no argument"),
        ("go_to", {"latitude_deg": 95, "longitude_deg": 0}, "latitude"),
        ("mode", {"mode": "GIUDED"}, "did you mean 'GUIDED'"),
        ("mode", {"mode": True}, "mode = True is no"),
        ("mission/start", {"item": -1}, "item"),
        ("mission/start", {"item": True}, "item = True is no integer"),
        ("arm", ["x"], "no JSON object"),
    ],
)
async def test_wrong_arguments_are_refused_before_anything_is_sent(
    order: str, body: object, text: str
) -> None:
    async with open_stage() as stage:
        stage.flight.wire.forget()
        answer = await stage.give(order, body)
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
        (b'{"altitude_m": 10}', {"Origin": "null"}, 403),
        (b'{"altitude_m": 10}', {"Origin": "http://127.0.0.1:9090"}, 403),
        (b'{"altitude_m": 10}', {"Sec-Fetch-Site": "cross-site"}, 403),
    ],
)
async def test_hostile_requests(content: bytes, headers: dict[str, str], status: int) -> None:
    async with open_stage() as stage:
        usual = {**BEARER, "Content-Type": "application/json", "Idempotency-Key": "12345678", "Host": HOST}
        answer = await stage.client.post(
            "/api/vehicles/1/take_off", content=content, headers={**usual, **headers}
        )
        assert answer.status_code == status
        assert "default-src 'none'" in answer.headers["content-security-policy"]
        assert "access-control-allow-origin" not in answer.headers
        assert stage.flight.wire.commands(MavCmd.NAV_TAKEOFF) == []


@pytest.mark.parametrize(
    ("order", "content"),
    [
        ("take_off", b'{"altitude_m": 1e999}'),
        ("mode", b'{"mode": "\\ud800"}'),
        ("mode", b'{"mode": "x\\udfff"}'),
    ],
)
async def test_what_json_cannot_tell_is_not_kept(order: str, content: bytes) -> None:
    """Else nobody could read the list of orders any more, nor open the stream."""
    async with open_stage() as stage:
        headers = {**BEARER, "Content-Type": "application/json", "Idempotency-Key": "12345678"}
        answer = await stage.client.post(f"/api/vehicles/1/{order}", content=content, headers=headers)
        assert answer.status_code == 400
        listed = await stage.client.get("/api/orders", headers=BEARER)
        assert (listed.status_code, listed.json()) == (200, {"orders": []})


async def test_another_vehicle_is_never_meant() -> None:
    async with open_stage() as stage:
        for name in ("2", "0", "256", "-1", "1.0", "٣", "one"):
            answer = await stage.client.post(
                f"/api/vehicles/{name}/arm",
                headers={**BEARER, "Idempotency-Key": f"key-{len(name)}-{name!a}"},
            )
            assert answer.status_code == 404
        assert stage.flight.wire.commands(MavCmd.COMPONENT_ARM_DISARM) == []


async def test_an_order_is_given_once() -> None:
    async with open_stage() as stage:
        answers = [await stage.give("arm", Idempotency_Key="the-same-key") for _ in range(3)]
        assert [each.json()["state"] for each in answers] == ["done"] * 3
        assert len(stage.flight.wire.commands(MavCmd.COMPONENT_ARM_DISARM)) == 1
        other = await stage.give("disarm", Idempotency_Key="the-same-key")
        assert (other.status_code, other.json()["error"]) == (409, "KeyUsed")
        assert stage.flight.copter.is_armed


async def test_nor_when_its_result_is_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("aerokit.apps.serve.orders.MOST_KEPT", 3)
    async with open_stage() as stage:
        await stage.give("arm", Idempotency_Key="the-same-key")
        await stage.give("disarm")
        for _ in range(4):
            await stage.give("mode", {"mode": "NONE"})
        again = await stage.give("arm", Idempotency_Key="the-same-key")
        assert (again.status_code, again.json()["error"]) == (409, "KeyUsed")
        assert not stage.flight.copter.is_armed


async def test_a_flood_of_keys_fills_no_memory_and_every_one_is_used_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("aerokit.apps.serve.orders.MOST_KEPT", 5)
    monkeypatch.setattr("aerokit.apps.serve.orders.MOST_KEYS", 20)
    async with open_stage() as stage:
        for number in range(40):
            await stage.give("disarm", Idempotency_Key=f"flood-{number:04}")
        orders = stage.app._orders
        assert (len(orders._kept), len(orders._spent)) == (5, 20)
        for number in (39, 20):
            answer = await stage.give("arm", Idempotency_Key=f"flood-{number:04}")
            assert answer.json()["error"] == "KeyUsed"
        assert not stage.flight.copter.is_armed


async def test_refusals_have_their_reasons() -> None:
    async with open_stage() as stage:
        stage.flight.copter.faults.refuse(
            MavCmd.COMPONENT_ARM_DISARM, MavResult.FAILED, "Arm: Compass not healthy"
        )
        refused = await stage.give("arm")
        assert (refused.status_code, refused.json()["error"]) == (409, "CommandRejected")
        assert "Arm: Compass not healthy" in refused.json()["reasons"]
        not_armed = await stage.give("take_off", {"altitude_m": 5})
        assert (not_armed.status_code, not_armed.json()["error"]) == (409, "OperationRejected")


async def test_a_silent_vehicle() -> None:
    async with open_stage() as stage:
        stage.flight.copter.faults.silent = True
        await anyio.sleep(5)
        stage.flight.wire.forget()
        answer = await stage.give("arm")
        assert (answer.status_code, answer.json()["error"]) == (503, "HeartbeatTimeout")
        assert stage.flight.wire.commands(MavCmd.COMPONENT_ARM_DISARM) == []
        landing = await stage.give("land")  # what brings it to rest is tried
        assert landing.status_code in (503, 504)
        assert stage.flight.wire.mode_orders() != []


async def test_a_client_that_goes_away_changes_nothing() -> None:
    async with open_stage() as stage:
        await stage.flight.take_off()
        there = stage.flight.vehicle.position.value.offset(north_m=40)
        place = {"latitude_deg": there.latitude_deg, "longitude_deg": there.longitude_deg}
        asking = asyncio.ensure_future(stage.give("go_to", place, Idempotency_Key="gone-away"))
        await anyio.sleep(3)
        asking.cancel()
        await asyncio.wait([asking])
        await anyio.sleep(30)
        assert stage.flight.vehicle.mode_name == "GUIDED"
        assert stage.flight.vehicle.position.value.distance_to(there) < 3
        record = await stage.client.get("/api/orders/gone-away", headers=BEARER)
        assert record.json()["state"] == "done"


async def test_a_newer_order_overrules_and_the_older_one_says_so() -> None:
    async with open_stage() as stage:
        await stage.flight.take_off()
        there = stage.flight.vehicle.position.value.offset(north_m=90)
        place = {"latitude_deg": there.latitude_deg, "longitude_deg": there.longitude_deg}
        started = await stage.give("go_to?wait=false", place, Idempotency_Key="older-one")
        assert (started.status_code, started.json()["state"]) == (202, "running")
        assert (await stage.give("hold")).status_code == 200
        older = (await stage.client.get("/api/orders/older-one", headers=BEARER)).json()
        assert (older["state"], older["problem"]["status"]) == ("failed", 409)


async def test_the_end_of_the_server_ends_in_holding() -> None:
    async with open_flight() as flight:
        await flight.take_off()
        there = flight.vehicle.position.value.offset(north_m=90)
        async with make_app(flight.vehicle, token=TOKEN) as app:
            orders = app._orders
            go_to = next(each for each in ORDERS if each.name == "go_to")
            place = {"latitude_deg": there.latitude_deg, "longitude_deg": there.longitude_deg}
            given = orders.give(flight.vehicle, go_to, place, "12345678", None)
            await anyio.sleep(3)
        assert given.state == "failed"
        await anyio.sleep(3)
        assert flight.vehicle.mode_name == "BRAKE"


async def test_read_only() -> None:
    async with open_stage(read_only=True, open_reading=True) as stage:
        for kind in ORDERS:
            answer = await stage.give(kind.name, {})
            assert (answer.status_code, answer.json()["error"]) == (403, "ReadOnly")
        written = await stage.client.put(
            "/api/vehicles/1/parameters/RTL_ALT",
            json={"value": 1},
            headers={**BEARER, "Idempotency-Key": "12345678"},
        )
        assert written.status_code == 403
        assert stage.app._orders.all() == []


async def test_a_parameter_is_set_and_told() -> None:
    async with open_stage() as stage:
        path, headers = "/api/vehicles/1/parameters/WPNAV_SPEED", {**BEARER, "Idempotency-Key": "set-it-now"}
        written = await stage.client.put(path, json={"value": 800}, headers=headers)
        assert (written.status_code, written.json()["result"]["value"]) == (200, 800)
        assert (await stage.client.get(path, headers=BEARER)).json()["value"] == 800
        missing = await stage.client.get("/api/vehicles/1/parameters/NO_SUCH", headers=BEARER)
        assert missing.status_code == 404


@pytest.mark.parametrize(
    "token", ["short", "x" * 300, "with space in the middle", "ümlaut-in-the-token-here"]
)
async def test_tokens_that_cannot_be(token: str) -> None:
    async with open_flight() as flight:
        with pytest.raises(InvalidArgument, match="token"):
            make_app(flight.vehicle, token=token)
