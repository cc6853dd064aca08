"""Opening a fleet: members and their names, streams, invalid arguments, the blocking twin."""

from __future__ import annotations

from typing import Any

import anyio
import pytest
from fleet_stage import open_stage

import aerokit
from aerokit import events, sync
from aerokit.errors import (
    BusyError,
    ConnectFailed,
    FleetError,
    InvalidArgument,
    OperationRejected,
    SubscriptionOverflow,
)
from aerokit.fleets.events import FleetEvent, MemberEvent, MemberReclaimed, MemberTakenOver, StateUpdate
from aerokit.fleets.members import MemberState
from aerokit.fleets.policy import FleetResult, MemberFailure, PolicyRules
from aerokit.missions import Mission
from aerokit.sim import SimulatedCopter, SimulatedPx4, simulated_link
from aerokit.sync.generator import FILES, generate

pytestmark = pytest.mark.anyio


def copters(*ids: int) -> list[SimulatedCopter]:
    return [SimulatedCopter(system_id=system_id, boot_time_s=0.0, seed=system_id) for system_id in ids]


async def test_fleet_accepts_connections_vehicles_and_links() -> None:
    async with (
        simulated_link(copters(1, 2)) as north,
        simulated_link(copters(1)) as south,
        simulated_link(SimulatedPx4(system_id=9, boot_time_s=0.0)) as west,
        aerokit.open_connection(north) as connection,
        aerokit.connect(south) as vehicle,
    ):
        sources: dict[str, Any] = {"north": connection, "scout": vehicle, "west": west}
        async with aerokit.fleet(sources, groups={"two": ["north/*"]}, roles={"eyes": ["scout"]}) as fleet:
            assert list(fleet.members) == ["scout", "north/1", "north/2", "west/9"]
            assert fleet.vehicles["scout"] is vehicle
            assert [member.name for member in fleet.group("two")] == ["north/1", "north/2"]
            assert [member.name for member in fleet.role("eyes")] == ["scout"]
            assert "north/2" in fleet
            assert len(fleet["*/[19]"]) == 2
            with pytest.raises(InvalidArgument, match="group = 'three' is not allowed: the groups are two"):
                fleet.group("three")
            with pytest.raises(InvalidArgument, match="role = 'x' is not allowed: the roles are eyes"):
                fleet.role("x")
            with pytest.raises(InvalidArgument, match=r"no fleet member matches 'east/\*'"):
                fleet["east/*"]
        assert connection.is_open
        assert not vehicle.is_silent


async def test_fleet_numbers_unnamed_networks_and_selects_system_ids() -> None:
    async with (
        simulated_link(copters(1, 2, 3)) as one,
        simulated_link(copters(2)) as two,
        aerokit.fleet(one, two, system_ids={"1": [3, 1]}) as fleet,
    ):
        assert list(fleet.members) == ["1/1", "1/3", "2/2"]


async def test_fleet_keeps_number_as_name_of_vehicle() -> None:
    async with (
        simulated_link(copters(1)) as one,
        simulated_link(copters(2)) as two,
        aerokit.connect(one) as named,
        aerokit.connect(two) as unnamed,
        aerokit.fleet({"7": named}, unnamed) as fleet,
    ):
        assert list(fleet.members) == ["7", "2/2"]


async def test_fleet_vehicle_already_connected_is_not_duplicated() -> None:
    async with (
        simulated_link(copters(1, 2)) as link,
        aerokit.open_connection(link) as connection,
        aerokit.connect(connection, system_id=1) as own,
    ):
        async with aerokit.fleet({"north": connection, "own": own}) as fleet:
            assert list(fleet.members) == ["own", "north/2"]
        with pytest.raises(BusyError):
            async with aerokit.fleet(connection, system_ids=[1]):
                raise AssertionError
        with pytest.raises(InvalidArgument, match="'a' and 'b' are the same vehicle"):
            async with aerokit.fleet({"a": own, "b": own}):
                raise AssertionError
        with pytest.raises(InvalidArgument, match="two vehicles are named 'north/2'"):
            async with aerokit.fleet({"north/2": own, "north": connection}):
                raise AssertionError


@pytest.mark.parametrize("returns", [False, True])
async def test_fleet_of_connection_ignores_vehicle_that_has_left(returns: bool) -> None:
    copters = [SimulatedCopter(system_id=number, boot_time_s=0.0) for number in (1, 2)]
    async with simulated_link(copters) as link, aerokit.open_connection(link) as connection:
        await anyio.sleep(5)
        copters[1].faults.silent = True
        await anyio.sleep(60)
        copters[1].faults.silent = not returns
        async with aerokit.fleet(connection) as fleet:
            assert list(fleet.members) == ["1/1", "1/2"][: 1 + returns]


async def test_fleet_missing_vehicles_are_listed_in_error() -> None:
    async with simulated_link(copters(1, 2)) as link:
        with pytest.raises(ConnectFailed, match=r"within 4 s 2 of 3 vehicles were found: north/1, north/2$"):
            async with aerokit.fleet({"north": link}, count=3, timeout=4):
                raise AssertionError


async def test_fleet_network_without_vehicles_is_named_in_error(caplog: pytest.LogCaptureFixture) -> None:
    async with (
        simulated_link(copters(1)) as north,
        simulated_link(copters(2)) as south,
        aerokit.open_connection(south) as quiet,
        aerokit.connect(quiet) as own,
    ):
        text = "within 6 s no vehicle was found on south; found: north/1\n  - network south: "
        with pytest.raises(ConnectFailed, match=text):
            async with aerokit.fleet({"north": north, "south": quiet}, timeout=6):
                raise AssertionError
        (text,) = [record.getMessage() for record in caplog.records]
        assert text == ("fleet: no vehicle was found on south; found: north/1 after 5 s; waiting up to 6 s in total")
        with pytest.raises(ConnectFailed, match=r"within 1 s 1 of 2 vehicles were found, 1 of them passed as vehicles"):
            async with aerokit.fleet({"scout": own, "south": quiet}, count=2, timeout=1):
                raise AssertionError


async def test_fleet_missing_system_id_is_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    async with simulated_link(copters(1, 2)) as link:
        with pytest.raises(ConnectFailed, match="system 7"):
            async with aerokit.fleet({"north": link}, system_ids=[1, 7], timeout=12):
                raise AssertionError
        (text,) = [record.getMessage() for record in caplog.records]
        assert text == "fleet: no heartbeat of north/7 after 5 s; waiting up to 12 s in total"


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"on_error": "panic"}, "on_error = 'panic'"),
        ({"on_error_by_group": {"a": "panic"}}, "on_error"),
        ({"on_error_by_group": {"typo": "land_others"}, "groups": {"two": ["1/*"]}}, "the groups are two"),
        ({"count": 0}, "count = 0"),
        ({"min_distance_m": 0.0}, "min_distance_m"),
        ({"on_too_close": "shout"}, "on_too_close"),
        ({"system_ids": [0]}, "system_ids: 0"),
        ({"system_ids": {"x": [1]}}, "'x' is not a network"),
        ({"groups": {"a": ["nobody"]}}, "no fleet member matches 'nobody'"),
        ({"groups": {"a": ["north/1"], "b": ["north/*"]}}, "two groups"),
    ],
)
async def test_fleet_invalid_arguments_are_rejected(options: dict[str, Any], match: str) -> None:
    async with simulated_link(copters(1)) as link:
        with pytest.raises(InvalidArgument, match=match):
            async with aerokit.fleet({"north": link}, **options):
                raise AssertionError


async def test_fleet_without_sources_is_rejected() -> None:
    with pytest.raises(InvalidArgument, match="needs at least one address"):
        async with aerokit.fleet():
            raise AssertionError


async def test_streams_have_events_and_states_of_all_members() -> None:
    async with open_stage(2, networks=("north", "south")) as stage:
        (await stage.fleet.wait_ready()).raise_for_errors()
        with (
            stage.fleet.events(events.ModeChanged) as modes,
            stage.fleet.events(MemberTakenOver) as taken,
            stage.fleet.states("armed", "position", every_arrival=True) as states,
            stage.fleet.events(capacity=2, overflow="error") as few,
        ):
            await stage.fleet.arm()
            (await stage.fleet["south/2"].set_mode("GUIDED")).raise_for_errors()
            event = await modes.get(timeout=5)
            assert isinstance(event, MemberEvent)
            assert (event.member, event.event.after) == ("south/2", "GUIDED")  # type: ignore[attr-defined]
            observed: set[tuple[str, str]] = set()
            with anyio.fail_after(5):
                async for state in states:
                    assert isinstance(state, StateUpdate)
                    observed.add((state.member, state.state))
                    if len(observed) == 8:
                        break
            assert taken.get_nowait() is None
            with pytest.raises(SubscriptionOverflow):
                async for _ in few:
                    pass
        for wrong, text in (((), "at least one state"), (("height",), "'height' is not a state")):
            with pytest.raises(InvalidArgument, match=text):
                stage.fleet.states(*wrong)
        with pytest.raises(InvalidArgument, match="a class of Event"):
            stage.fleet.events(int)  # type: ignore[arg-type]


async def test_released_member_gets_no_orders_until_reclaimed() -> None:
    async with open_stage(2) as stage:
        await stage.take_off()
        stage.fleet.release("north/2", "it films")
        result = await stage.fleet.hold()
        assert result.skipped == {"north/2": "released: it films"}
        assert stage.fleet.members["north/2"].state is MemberState.RELEASED
        assert not stage.orders_to("north/2")
        stage.fleet.reclaim("north/2")
        assert (await stage.fleet.land()).is_complete


async def test_fleet_exit_detaches_all_vehicles() -> None:
    async with simulated_link(copters(1, 2, 3)) as link, aerokit.open_connection(link) as connection:
        before = len(connection.bus._event_sinks), set(connection.attached)
        async with aerokit.fleet(connection, count=3) as fleet:
            with fleet.events(FleetEvent):
                assert connection.attached == {1, 2, 3}
        assert (len(connection.bus._event_sinks), connection.attached) == before
        async with aerokit.connect(connection, system_id=2):
            pass


async def test_fleet_methods_wrong_types_are_rejected_and_nothing_sent() -> None:
    async with open_stage(2) as stage:
        fleet: Any = stage.fleet
        (await stage.fleet.wait_ready()).raise_for_errors()
        place = fleet.vehicles["north/1"].position.value
        line = aerokit.Formation.line(["north/2"], 5.0)
        corridors = {"by": "corridors", "min_distance_m": 5, "speed_m_s": 5}
        show = aerokit.Show.from_points({"north/1": [(0, 0, 0, 5), (5, 1, 0, 5)]})
        stage.clear()
        wrong: list[tuple[str, tuple[Any, ...], dict[str, Any]]] = [
            ("take_off", ("ten",), {}),
            ("take_off", (-1,), {}),
            ("take_off", (10,), {"timeout": 0}),
            ("take_off", (10,), {"stagger_s": -1}),
            ("land", (), {"timeout": "1"}),
            ("set_mode", (1.5,), {}),
            ("do", (7,), {}),
            ("do", (print, 1), {}),
            ("go_to", ({"north/1": (47, 8)},), {}),
            ("go_to", ({"north/9": place},), {}),
            ("go_to", ({"north/1": place},), {"separation": "yes"}),
            ("plan_separation", ({"north/1": place},), {"by": "luck"}),
            ("plan_separation", ({"north/1": place},), {}),
            ("plan_separation", ({"north/1": place},), {**corridors, "speed_m_s": float("inf")}),
            ("plan_separation", ({"north/1": place},), {**corridors, "slack_s": -1}),
            ("barrier", (True,), {}),
            ("wait_at_altitude", (None,), {}),
            ("upload", ({"north/1": 5},), {}),
            ("upload", ({"north/9": Mission()},), {}),
            ("upload", ({"north/1": Mission()},), {"max_concurrent": 0}),
            ("compare_missions", ({"north/1": Mission()},), {}),
            ("form", (line,), {"leader": 1}),
            ("form", ("line",), {"leader": "north/1"}),
            ("following", (line,), {"leader": "north/1", "rate_hz": 1000}),
            ("fly_show", ("show", place), {}),
            ("fly_show", (show, place), {"start_in_s": float("inf")}),
            ("fly_show", (show, place), {"lead_s": float("inf")}),
            ("send_corrections", ("text",), {}),
            ("reclaim", (1,), {}),
            ("reclaim", ("north/9",), {}),
            ("release", ("north/9",), {}),
            ("group", (None,), {}),
            ("events", (), {"capacity": 0}),
        ]
        for name, arguments, options in wrong:
            with pytest.raises((InvalidArgument, FleetError)) as caught:
                done = getattr(fleet, name)(*arguments, **options)
                done = await done if hasattr(done, "__await__") else done
                if isinstance(done, FleetResult):
                    done.raise_for_errors()
            errors = caught.value.errors.values() if isinstance(caught.value, FleetError) else ()
            assert all(isinstance(error, (InvalidArgument, OperationRejected)) for error in errors), name
        assert not stage.orders_to("north/1")
        assert not stage.orders_to("north/2")


def test_fleet_result_shows_failed_and_skipped_members() -> None:
    error = ValueError("no")
    result = FleetResult("land", {"a": None, "b": error}, failed={"b": error}, stopped={}, skipped={"c": "lost"})
    assert repr(result) == "<FleetResult of land: 1 of 2 done; failed: b; skipped: c>"
    assert dict(result) == {"a": None, "b": error}
    with pytest.raises(aerokit.errors.FleetError, match=r"land: 1 of 2 members succeeded\n  - b: no"):
        result.raise_for_errors()


def test_policy_rules_reject_invalid_decisions() -> None:
    failure = MemberFailure("a", "", "go_to", ValueError(), ("b", "c"))
    assert PolicyRules("continue_others", {}).decide(failure) == {}
    assert PolicyRules("return_others", {}).decide(failure) == {"b": "return", "c": "return"}
    assert PolicyRules(lambda _: None, {}).decide(failure) == {}
    assert PolicyRules(lambda _: "land_others", {}).decide(failure) == {"b": "land", "c": "land"}
    for decision in ({"x": "land"}, {"b": "jump"}, "halt", 7):
        with pytest.raises(InvalidArgument, match="the policy function returned"):
            PolicyRules(lambda _, it=decision: it, {}).decide(failure)  # type: ignore[misc]


def test_blocking_twin_flies_fleet() -> None:
    from aerokit.testing.served import hosted_flight

    with hosted_flight("copter", boot_time_s=0.0) as served:
        with sync.fleet({"north": served.address}, count=1) as fleet:
            assert repr(fleet) == "<Fleet of 1: north/1>"
            with fleet.events(events.ArmedChanged) as received:
                fleet.wait_ready().raise_for_errors()
                fleet.arm().raise_for_errors()
                assert fleet.take_off(5).is_complete
                assert received.get(timeout=5).member == "north/1"
            assert isinstance(fleet.vehicles["north/1"], sync.Vehicle)
            assert fleet.vehicles["north/1"].is_armed
            assert fleet["north/*"].land()["north/1"] is None
        with pytest.raises(InvalidArgument):
            sync.fleet({"north": served.address}, count=0)


def test_fleet_twins_match_generator_output() -> None:
    assert FILES["fleet_twins"].read_text(encoding="utf-8") == generate("fleet_twins")


async def test_events_of_base_class_has_events_of_fleet_and_vehicles() -> None:
    async with open_stage(1) as stage:
        with stage.fleet.events(events.Event) as received:
            stage.fleet.release("north/1")
            stage.fleet.reclaim("north/1")
            await stage.fleet.set_mode("GUIDED")
            found = set()
            while (event := received.get_nowait()) is not None:
                found.add(type(event))
            assert found == {MemberReclaimed, MemberEvent}
