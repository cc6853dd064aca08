"""The blocking twin: the same signatures, the same errors, Ctrl-C, and nothing left behind."""

from __future__ import annotations

import contextlib
import inspect
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from typing import Any

import pytest
from ctrl_c import interrupt_when, is_waiting_for_loop
from for_each import for_each
from served_copter import served, served_copter, without_loop_warnings

import aerokit
import aerokit.sync
import aerokit.sync.twins
from aerokit import errors, events, messages
from aerokit.connection.bus import Subscription
from aerokit.connection.cells import StateCell
from aerokit.connection.opening import open_connection
from aerokit.events import LinkState
from aerokit.mavlink.enums import MavCmd, MavResult
from aerokit.missions import Fence, FenceCircle, Mission, waypoint
from aerokit.sim import SimulatedCopter, SimulatedGimbal
from aerokit.sync import generator
from aerokit.sync.thread_future import ThreadFuture
from aerokit.vehicle.commanding.guided import Guided, SetpointStream
from aerokit.vehicle.commanding.setpoints import VelocitySetpoint
from aerokit.vehicle.files.files import Files
from aerokit.vehicle.files.logs import Logs
from aerokit.vehicle.missions.mission import MissionControl
from aerokit.vehicle.missions.plans import FenceControl, RallyControl
from aerokit.vehicle.parameters.parameters import Parameters, Transaction
from aerokit.vehicle.state.field import StateField

LOOP_THREAD = "aerokit loop"


def loop_threads() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name == LOOP_THREAD]


@pytest.fixture(autouse=True)
def _no_thread_is_left() -> Iterator[None]:
    yield
    for thread in loop_threads():
        thread.join(100)  # closed by another thread a moment ago
    assert not loop_threads()


@pytest.fixture
def copter() -> SimulatedCopter:
    return SimulatedCopter(boot_time_s=0.0)


@pytest.fixture
def vehicle(copter: SimulatedCopter) -> Iterator[aerokit.sync.Vehicle]:
    with served([copter]) as address, aerokit.sync.connect(address) as vehicle:
        yield vehicle


# ------------------------------------------------------------------------------------- twins


def public_names(cls: type) -> set[str]:
    return {name for name in dir(cls) if not name.startswith("_")}


def parameters(function: Any) -> list[inspect.Parameter]:
    return list(inspect.signature(function).parameters.values())


def kind_of(cls: type, name: str) -> str:
    member = inspect.getattr_static(cls, name)
    return "value" if isinstance(member, (property, cached_property, StateField)) else "method"


TWINS: list[tuple[type, type, set[str]]] = [
    (aerokit.Vehicle, aerokit.sync.Vehicle, set()),
    (StateCell, aerokit.sync.StateCell, {"observe", "set", "forget", "close"}),
    (Guided, aerokit.sync.Guided, set()),
    (SetpointStream, aerokit.sync.SetpointStream, set()),
    (Files, aerokit.sync.twins.Files, set()),
    (Logs, aerokit.sync.twins.Logs, set()),
    (MissionControl, aerokit.sync.twins.MissionControl, set()),
    (FenceControl, aerokit.sync.twins.FenceControl, set()),
    (RallyControl, aerokit.sync.twins.RallyControl, set()),
    (Parameters, aerokit.sync.twins.Parameters, set()),
    (Transaction, aerokit.sync.twins.Transaction, set()),
    (Subscription, aerokit.sync.Subscription, set()),
]
MEMBERS = [
    (original, twin, name) for original, twin, left_out in TWINS for name in sorted(public_names(original) - left_out)
]


@for_each("original, twin, name", MEMBERS)
def test_every_member_has_a_twin(original: type, twin: type, name: str) -> None:
    assert hasattr(twin, name), "it has no twin: run python -m aerokit.sync.generator"
    if name in original.__dict__.get("__slots__", ()):
        return
    assert kind_of(original, name) == kind_of(twin, name)
    if kind_of(original, name) == "method":
        assert not inspect.iscoroutinefunction(getattr(twin, name))
        given, wanted = (inspect.signature(getattr(cls, name)).parameters for cls in (twin, original))
        assert [(parameter.name, parameter.kind, parameter.default) for parameter in given.values()] == [
            (parameter.name, parameter.kind, parameter.default) for parameter in wanted.values()
        ]


def test_twins_match_generator_output(capsys: pytest.CaptureFixture[str]) -> None:
    assert generator.main(["--check"]) == 0, capsys.readouterr().out


@pytest.mark.parametrize("name", ["connect", "open_connection"])
def test_functions_have_same_signatures(name: str) -> None:
    assert parameters(getattr(aerokit.sync, name)) == parameters(getattr(aerokit, name))


def test_vehicle_twin_has_instance_attributes(vehicle: aerokit.sync.Vehicle) -> None:
    internal = {"telemetry"}
    public = {name for name in vars(vehicle.aio) if not name.startswith("_")} - internal
    assert not {name for name in public if not hasattr(vehicle, name)}


def test_importing_aerokit_does_not_import_sync() -> None:
    code = "import sys, aerokit; sys.exit('aerokit.sync' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


# ------------------------------------------------------------------------------------ flying


def test_a_flight(vehicle: aerokit.sync.Vehicle) -> None:
    vehicle.wait_ready()
    assert not vehicle.is_armed
    assert vehicle.why_not_armable() == []
    vehicle.set_mode("GUIDED")
    assert vehicle.mode.value.name == vehicle.mode_name == "GUIDED"
    vehicle.arm()
    vehicle.take_off(6)
    assert vehicle.position.fresh(within=5).altitude_relative_m == pytest.approx(6, abs=1)
    target = vehicle.position.value.offset(east_m=8)
    vehicle.go_to(target)
    assert vehicle.distance_to(target) < 3
    vehicle.land()
    assert vehicle.armed.wait_until(lambda armed: not armed, timeout=100) is False


def test_setpoints_are_streamed_in_with_block(vehicle: aerokit.sync.Vehicle) -> None:
    vehicle.wait_ready()
    vehicle.arm()
    vehicle.take_off(5)
    start = vehicle.position.value
    with vehicle.guided.velocity(valid_for_s=60.0, max_lag_s=60.0) as stream:
        running = [stream.is_running]
        while vehicle.distance_to(start) <= 1:  # A busy machine simulates fewer seconds in the same time.
            stream.fly(VelocitySetpoint(north_m_s=3), 0.2)
    assert [*running, stream.is_running] == [True, False]
    assert vehicle.mode_name == "BRAKE"
    with pytest.raises(errors.SetpointStreamStopped):
        stream.set(VelocitySetpoint())


def test_commands_and_rejections(vehicle: aerokit.sync.Vehicle, copter: SimulatedCopter) -> None:
    assert vehicle.command(MavCmd.REQUEST_MESSAGE, messages.AutopilotVersion.ID).result == MavResult.ACCEPTED
    copter.faults.refuse(MavCmd.DO_SET_ROI_NONE, MavResult.DENIED, "No such thing")
    with pytest.raises(errors.CommandRejected) as refused:
        vehicle.stop_looking()
    assert refused.value.result == MavResult.DENIED
    assert "No such thing" in refused.value.reasons


def test_exceptions_propagate_unchanged(vehicle: aerokit.sync.Vehicle) -> None:
    with pytest.raises(errors.InvalidArgument, match="FASTER"):
        vehicle.set_mode("FASTER")
    with pytest.raises(errors.OperationRejected, match="not armed"):
        vehicle.take_off(5)
    with pytest.raises(ZeroDivisionError):
        vehicle.armed.wait_until(lambda armed: 1 / 0)


# ----------------------------------------------------------------------- following and waiting


def test_subscription_is_iterable(vehicle: aerokit.sync.Vehicle) -> None:
    with vehicle.subscribe(messages.Attitude, capacity=20, rate_hz=10) as attitudes:
        for number, attitude in enumerate(attitudes):
            assert isinstance(attitude, messages.Attitude)
            if number == 3:
                break
        assert isinstance(attitudes.get(timeout=100), messages.Attitude)
        assert attitudes.missed == 0
        attitudes.close()
        while attitudes.get_nowait() is not None:
            pass
        assert list(attitudes) == []


def test_subscription_get_times_out(vehicle: aerokit.sync.Vehicle) -> None:
    with vehicle.subscribe(events.VehicleRebooted) as reboots, pytest.raises(errors.OperationTimeout):
        reboots.get(timeout=0.01)


def test_changes_are_iterable(vehicle: aerokit.sync.Vehicle) -> None:
    changes = vehicle.system_time.updates()
    assert next(changes).since_boot_s < next(changes).since_boot_s
    assert changes.missed >= 0


def test_cells_read_without_the_loop(vehicle: aerokit.sync.Vehicle) -> None:
    vehicle.wait_ready()
    cell = vehicle.position
    assert cell is vehicle.position
    assert cell.name == "position"
    assert cell.is_known
    assert cell.source is not None
    vehicle.close()
    assert cell.latest == cell.value
    assert 0 <= cell.age < 60
    with pytest.raises(TypeError, match="has no truth value"):
        bool(cell)
    with pytest.raises(TypeError, match=r"use position.value\[…\]"):
        _ = cell[0]  # type: ignore[index]
    with pytest.raises(errors.ConnectionClosed):
        cell.wait_until(lambda _: False)


def test_rate_lasts_for_its_block(vehicle: aerokit.sync.Vehicle) -> None:
    with (
        vehicle.subscribe(messages.Vibration) as vibrations,
        vehicle.rate(messages.Vibration, 10),
    ):
        assert vibrations.get(timeout=100)


# -------------------------------------------------------------------- ends of the connection


def test_close_is_idempotent_and_ends_thread() -> None:
    with served_copter() as address:
        vehicle = aerokit.sync.connect(address)
        assert len(loop_threads()) == 1
        vehicle.close()
        vehicle.close()
        assert not loop_threads()
        with pytest.raises(errors.ConnectionClosed):
            vehicle.arm()
        with pytest.raises(errors.ConnectionClosed):
            vehicle.send(messages.Ping(0, 0, 0, 0))


def test_close_from_another_thread_ends_waiting_call() -> None:
    with served_copter() as address:
        vehicle = aerokit.sync.connect(address)
        threading.Timer(0.05, vehicle.close).start()
        with pytest.raises(errors.ConnectionClosed):
            vehicle.armed.wait_until(lambda armed: armed, timeout=60)
        vehicle.close()


def test_end_of_link_ends_waiting_call() -> None:
    with served_copter() as address:
        vehicle = aerokit.sync.connect(address)
        started = threading.Event()

        def note(armed: bool) -> bool:
            started.set()
            return armed

        def wait() -> None:
            with pytest.raises((errors.LinkLost, errors.ConnectionClosed)):
                vehicle.armed.wait_until(note, timeout=60)

        waiting = threading.Thread(target=wait)
        waiting.start()
        assert started.wait(100)
    waiting.join(100)
    assert not waiting.is_alive()
    vehicle.close()


def test_reconnecting_link(copter: SimulatedCopter) -> None:
    with contextlib.ExitStack() as stack:
        with served([copter]) as address:
            vehicle = stack.enter_context(aerokit.sync.connect(address, reconnect=True))
            restored = stack.enter_context(vehicle.subscribe(events.LinkRestored))
            vehicle.wait_ready()
        with served([copter], address.replace("tcp:", "tcpin:")):
            restored.get(timeout=100)
            # A simulation of this speed may count as another vehicle first, which ends orders in progress.
            vehicle.link_state.wait_until(lambda state: state is LinkState.CONNECTED, timeout=100)
            vehicle.position.wait_until(lambda _: vehicle.position.age < 1, timeout=100)
            vehicle.arm()
            assert vehicle.is_armed
            assert len(vehicle.parameters.download()) > 100


def test_blocking_call_on_loop_thread_raises(vehicle: aerokit.sync.Vehicle) -> None:
    def predicate(armed: bool) -> bool:
        vehicle.hold()
        return armed

    with pytest.raises(errors.BusyError, match="loop's own thread"):
        vehicle.armed.wait_until(predicate)


def test_close_on_loop_thread(copter: SimulatedCopter) -> None:
    with served([copter]) as address:
        vehicle = aerokit.sync.connect(address)
        thread = loop_threads()[0]
        with pytest.raises(errors.ConnectionClosed):
            vehicle.armed.wait_until(lambda armed: vehicle.close())
        thread.join(100)


def test_failed_connect_leaves_no_thread() -> None:
    with pytest.raises(errors.InvalidArgument):
        aerokit.sync.connect("nonsense")
    with pytest.raises(errors.LinkOpenError):
        aerokit.sync.connect(f"tcp:127.0.0.1:{unused_port()}")
    with pytest.raises(errors.ConnectFailed):
        aerokit.sync.connect("udpin:127.0.0.1:0", timeout=0.05)
    with pytest.raises(errors.InvalidArgument):
        aerokit.sync.open_connection("nonsense")


def unused_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@pytest.mark.skipif(not hasattr(signal, "pthread_kill"), reason="needs POSIX signals")
def test_ctrl_c_cancels_call_and_vehicle_holds(vehicle: aerokit.sync.Vehicle) -> None:
    vehicle.wait_ready()
    vehicle.arm()
    vehicle.take_off(5)
    with pytest.raises(KeyboardInterrupt):
        interrupt_when(lambda: vehicle.velocity.value.ground_speed_m_s > 1)
        vehicle.go_to(vehicle.position.value.offset(north_m=2000))
    vehicle.mode.wait_until(lambda mode: mode.name == "BRAKE", timeout=100)


@pytest.mark.skipif(not hasattr(signal, "pthread_kill"), reason="needs POSIX signals")
def test_ctrl_c_cancels_connect() -> None:
    with pytest.raises(KeyboardInterrupt) as caught:
        interrupt_when(is_waiting_for_loop)
        aerokit.sync.connect("udpin:127.0.0.1:0", timeout=60)
    assert len(caught.traceback) <= 4, "without the places where the library waited"
    assert loop_threads() == []


def test_ctrl_c_while_loop_starts_has_short_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(self: ThreadFuture[Any], timeout: float) -> bool:
        raise KeyboardInterrupt

    monkeypatch.setattr(ThreadFuture, "wait", interrupted)
    with pytest.raises(KeyboardInterrupt) as caught:
        aerokit.sync.connect("udpin:127.0.0.1:0", timeout=60)
    assert len(caught.traceback) <= 4


@pytest.mark.skipif(not hasattr(signal, "pthread_kill"), reason="needs POSIX signals")
@pytest.mark.exhaustive
def test_interrupt_helper_works_if_sigint_is_ignored() -> None:
    test = f"{__file__}::{test_ctrl_c_cancels_connect.__name__}"
    ignore = "import signal, sys, pytest; signal.signal(signal.SIGINT, signal.SIG_IGN)"
    code = f"{ignore}; sys.exit(pytest.main(sys.argv[1:]))"
    command = [sys.executable, "-c", code, "-n", "0", "-q", "-p", "no:cacheprovider", "--timeout", "50", test]
    done = subprocess.run(command, capture_output=True, text=True, timeout=200, check=False)
    assert (done.returncode, done.stderr) == (0, ""), done.stdout


def test_program_without_close_exits() -> None:
    code = "import sys, aerokit.sync; vehicle = aerokit.sync.connect(sys.argv[1]); print(vehicle.system_id)"
    with served_copter(system_id=7) as address:
        done = subprocess.run(
            [sys.executable, "-W", "error", "-c", code, address],
            capture_output=True,
            text=True,
            timeout=200,
            check=False,
        )
    assert (done.returncode, done.stdout, without_loop_warnings(done.stderr)) == (0, "7\n", "")


# --------------------------------------------------------------------------------- missions


def test_missions_fences_and_rally_points(vehicle: aerokit.sync.Vehicle) -> None:
    place = vehicle.home.wait_until(lambda _: True, timeout=100).position
    mission = Mission([waypoint(place.latitude_deg, place.longitude_deg, altitude_relative_m=20)] * 3)
    vehicle.mission.upload(mission)
    assert mission.matches(vehicle.mission.download(method="items"))
    assert vehicle.mission.count.value == 3
    with pytest.raises(errors.OperationRejected, match="not armed"):
        vehicle.mission.start()
    vehicle.fence.upload(Fence(circles=[FenceCircle(place, 100.0)]))
    vehicle.rally.clear()
    vehicle.mission.clear()
    assert vehicle.mission.count.value == 0


# ------------------------------------------------------------------------- several vehicles


def test_links_cell_of_several_links() -> None:
    with served_copter() as address:
        with aerokit.sync.connect([address, "udpin:127.0.0.1:0"], rates={}) as vehicle:
            links = vehicle.connection.links
            assert isinstance(links, aerokit.sync.StateCell)
            states = links.wait_until(lambda statuses: statuses[0].state is LinkState.CONNECTED, timeout=100)
            assert [state.link.split(":")[0] for state in states] == ["tcp", "udpin"]
            assert links.value[0].used_for == (1,)
        with aerokit.sync.connect(address, rates={}) as vehicle:
            assert vehicle.connection.links is None


def test_vehicles_on_one_connection_share_its_thread() -> None:
    copters = [SimulatedCopter(system_id=number, boot_time_s=0.0) for number in (1, 2)]
    with (
        served(copters) as address,
        aerokit.sync.open_connection(address) as connection,
        aerokit.sync.connect(connection, system_id=1) as first,
        aerokit.sync.connect(connection, system_id=2) as second,
    ):
        assert len(loop_threads()) == 1
        second.wait_ready()
        second.arm()
        assert (first.is_armed, second.is_armed) == (False, True)
        second.close()
        assert connection.is_open
        first.set_mode("GUIDED")
        assert connection.counts(1)[0] > 0
        with connection.subscribe(messages.Heartbeat, capacity=10) as heartbeats:
            assert heartbeats.get(timeout=100)


def test_vehicles_iterator() -> None:
    with (
        served([SimulatedCopter(boot_time_s=0.0)]) as address,
        aerokit.sync.open_connection(address) as connection,
    ):
        first = next(iter(connection.vehicles()))
        for found in connection.vehicles():
            with aerokit.sync.connect(connection, system_id=found.system_id) as vehicle:
                assert vehicle.components.value[0].kind == "autopilot"
                assert vehicle.component(1).kind == "autopilot"
                assert vehicle.component(1).files.aio is vehicle.files.aio
            break
        search = connection.vehicles()
        assert next(search).system_id == first.system_id
    with pytest.raises(errors.ConnectionClosed):
        next(search)


def test_aio_is_the_asynchronous_vehicle(vehicle: aerokit.sync.Vehicle) -> None:
    assert isinstance(vehicle.aio, aerokit.Vehicle)
    assert inspect.isasyncgenfunction(inspect.unwrap(open_connection))


def test_exception_in_flight_logs_vehicle_state(caplog: pytest.LogCaptureFixture) -> None:
    with (
        served_copter() as address,
        pytest.raises(KeyboardInterrupt),
        aerokit.sync.connect(address) as vehicle,
    ):
        vehicle.wait_ready()
        vehicle.arm()
        vehicle.take_off(5)
        raise KeyboardInterrupt
    assert "vehicle 1 was left: in GUIDED, still armed, " in caplog.text


# -------------------------------------------------------------------------- first access to components


def test_part_can_be_first_read_in_predicate(vehicle: aerokit.sync.Vehicle) -> None:
    """The predicate runs on the loop's thread while another thread reads the component for the first time."""
    entered = threading.Event()

    def looks(_: object) -> bool:
        entered.set()
        return vehicle.mission.current.latest != 99 and vehicle.gimbal.attitude.latest is None

    with ThreadPoolExecutor(1) as threads:
        waiting = threads.submit(vehicle.position.wait_until, looks, timeout=60)
        assert entered.wait(100)
        assert vehicle.mission is vehicle.mission
        waiting.result()


def test_parts_first_read_after_close_are_empty(copter: SimulatedCopter) -> None:
    with served([copter]) as address, aerokit.sync.connect(address) as vehicle:
        pass
    assert len(vehicle.parameters.table) == 0
    assert (vehicle.mission.current.latest, vehicle.gimbal.attitude.latest) == (None, None)
    with pytest.raises(errors.ConnectionClosed):
        vehicle.fence.download()


@pytest.mark.exhaustive
def test_gimbals_are_found_and_controlled() -> None:
    gimbal = SimulatedGimbal(171)
    with (
        served_copter(parameters={"MNT1_TYPE": 1.0}, components=[gimbal]) as address,
        aerokit.sync.connect(address) as vehicle,
    ):
        assert vehicle.gimbals.discover() == (1, 171)
        assert [gimbal.device_id for gimbal in vehicle.gimbals] == [1, 171]
        assert len(vehicle.gimbals) == 2
        with vehicle.gimbals[171].control() as control:
            vehicle.gimbals[171].point(-20.0, 0.0, frame="vehicle")
            was_held = control.is_held
            with vehicle.gimbals[171].rates(rate_hz=50) as rates:
                rates.turn(-1.0, 0.0, 0.2)
        assert (was_held, control.is_held) == (True, False)
        with pytest.raises(errors.NotSupported):
            vehicle.gimbal.control(secondary=True).__enter__()
