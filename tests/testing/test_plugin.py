"""The pytest plugin in user projects, each in a folder of its own."""

from __future__ import annotations

import subprocess
import sys
from importlib.machinery import SourceFileLoader

import pytest

import aerokit.errors

pytest_plugins = ["pytester"]

ASYNC = """
import pytest

async def go(vehicle):
    await vehicle.wait_ready()
    if vehicle.autopilot.firmware == "ArduPilot":
        await vehicle.set_mode("GUIDED")
    await vehicle.arm()
    await vehicle.take_off(10)
    await vehicle.land()
    await vehicle.armed.wait_until(lambda armed: not armed, timeout=30)

@pytest.mark.simulated({kind!r}, seed=2)
async def test_async(flight):
    await go(flight.vehicle)
    flight.track.assert_reached_altitude(10)
    flight.track.assert_landed_near(within_m=2)
    flight.track.assert_disarmed_at_end()

@pytest.mark.simulated({kind!r})
def test_plain(flight):
    flight.run(lambda flight: go(flight.vehicle))
    flight.track.assert_reached_altitude(10)
"""


def run(pytester: pytest.Pytester, source: str, *arguments: str) -> pytest.RunResult:
    pytester.makepyfile(source)
    plugin = ("-p", "no:aerokit", "-p", "aerokit.testing.plugin")  # Loads the plugin even if aerokit is not installed.
    asyncio = () if "pytest_asyncio" in arguments else ("-p", "no:asyncio")
    return pytester.runpytest_inprocess(
        *plugin,
        *asyncio,
        "-p",
        "no:xdist",
        "-p",
        "no:cacheprovider",
        "--assert=plain",
        "-W",
        "error",
        *arguments,
    )


@pytest.mark.exhaustive
@pytest.mark.parametrize("kind", ["copter", "px4"])
def test_flights_need_no_async_plugin(pytester: pytest.Pytester, kind: str) -> None:
    run(pytester, ASYNC.format(kind=kind), "-p", "no:anyio").assert_outcomes(passed=2)


def test_flights_share_loop_of_anyio_plugin(pytester: pytest.Pytester) -> None:
    source = """
    import asyncio, pytest
    from aerokit.testing import VIRTUAL_BACKEND

    @pytest.fixture
    def anyio_backend():
        return VIRTUAL_BACKEND

    @pytest.fixture
    async def loop(anyio_backend):
        yield asyncio.get_running_loop()

    @pytest.mark.anyio
    async def test_it(flight, loop):
        assert asyncio.get_running_loop() is loop
        await flight.vehicle.wait_ready()
    """
    run(pytester, source).assert_outcomes(passed=1)


PYTEST_ASYNCIO = """
import asyncio, pytest, pytest_asyncio
from aerokit.testing import VirtualClockLoop

@pytest_asyncio.fixture
async def number():
    await asyncio.sleep(0)
    yield 5

@pytest.mark.asyncio
@pytest.mark.simulated("px4")
async def test_one(flight, number):
    assert isinstance(asyncio.get_running_loop(), VirtualClockLoop)
    await flight.vehicle.wait_ready()
    assert number == 5

class TestSeveral:
    @pytest.mark.asyncio
    async def test_fleet(self, fleet):
        for vehicle in fleet.vehicles:
            await vehicle.wait_ready()

async def test_without_its_marker(flight):
    await flight.vehicle.wait_ready()

@pytest.mark.asyncio
async def test_that_does_not_fly():
    assert not isinstance(asyncio.get_running_loop(), VirtualClockLoop)

@pytest.mark.asyncio
async def test_that_fails(flight):
    await flight.vehicle.wait_ready()
    flight.track.assert_reached_altitude(5)
"""


@pytest.mark.exhaustive
@pytest.mark.parametrize("mode", ["auto", "strict"])
def test_pytest_asyncio_tests_run_on_virtual_time(pytester: pytest.Pytester, mode: str) -> None:
    pytest.importorskip("pytest_asyncio")
    options = ("-p", "pytest_asyncio", "-o", "asyncio_default_fixture_loop_scope=function")
    result = run(pytester, PYTEST_ASYNCIO, *options, f"--asyncio-mode={mode}")
    result.assert_outcomes(passed=4, failed=1)
    assert "the vehicle did not reach 5 m" in result.stdout.str()


def test_failed_test_describes_the_flight(pytester: pytest.Pytester) -> None:
    source = """
    import pytest

    @pytest.mark.parametrize("path", ["a/b"])
    async def test_it(flight, path):
        await flight.vehicle.wait_ready()
        assert False

    def test_served(served_flight):
        assert False

    def test_nothing(fleet):
        assert False
    """
    result = run(pytester, source, "--flight-pictures", "pictures/of failures")
    result.assert_outcomes(failed=3)
    result.stdout.fnmatch_lines(
        [
            "*- simulated flights -*",
            "system 1: STABILIZE, armed for 0.0 s, up to 0.0 m high and 0.0 m away",
            "  ended at *, disarmed, STABILIZE",
            "  text at * INFO 'EKF3 IMU0 is using GPS'",
            "track in pictures*test_failed_test_describes_the_flight.py-test_it-a-b.svg",
        ]
    )
    result.stdout.fnmatch_lines(["system 2: not switched on"])
    assert len(list((pytester.path / "pictures" / "of failures").glob("*.svg"))) == 3


@pytest.mark.exhaustive
def test_vehicle_error_fails_the_test(pytester: pytest.Pytester) -> None:
    source = """
    import pytest, time
    from aerokit import messages

    def make_a_mistake(*_):
        raise LookupError("mine")

    async def test_async(flight):
        flight.simulated.on(messages.CommandLong, make_a_mistake)
        await flight.vehicle.wait_ready()
        await flight.vehicle.arm()

    def test_blocking(blocking_vehicle, served_flight):
        blocking_vehicle.wait_ready()
        served_flight.simulated.on(messages.CommandLong, make_a_mistake)
        blocking_vehicle.arm()

    def test_classic(dronekit, dronekit_address, served_flight):
        vehicle = dronekit.connect(dronekit_address, wait_ready=["armed"])
        served_flight.simulated.on(messages.CommandLong, make_a_mistake)
        try:
            vehicle.armed = True
            while not vehicle.armed:
                time.sleep(1)
        finally:
            vehicle.close()

    def test_afterwards(blocking_vehicle):
        assert blocking_vehicle.armed.value is False
    """
    result = run(pytester, source, "-p", "no:logging")
    result.assert_outcomes(failed=3, passed=1)
    assert result.stdout.str().count("E       LookupError: mine") == 3


@pytest.mark.exhaustive
def test_a_fleet(pytester: pytest.Pytester) -> None:
    source = """
    import pytest

    @pytest.mark.simulated("copter", count=3)
    async def test_three(fleet):
        for vehicle in fleet.vehicles:
            await vehicle.wait_ready()
        await fleet[1].vehicle.arm()
        assert [each.simulated.is_armed for each in fleet] == [False, True, False]
        assert [each.system_id for each in fleet.vehicles] == [1, 2, 3]

    @pytest.mark.simulated("copter", "px4")
    def test_mixed(fleet):
        async def main(fleet):
            return [vehicle.autopilot.firmware for vehicle in fleet.vehicles]
        assert len(set(fleet.run(main))) == 2
    """
    run(pytester, source).assert_outcomes(passed=2)


def test_programs_that_connect_themselves(pytester: pytest.Pytester) -> None:
    source = """
    import aerokit, pytest

    @pytest.mark.simulated(connect=False)
    async def test_it(flight):
        async with aerokit.connect(flight.link) as vehicle:
            await vehicle.wait_ready()
        with pytest.raises(RuntimeError, match="connect=False"):
            flight.vehicle
    """
    run(pytester, source).assert_outcomes(passed=1)


def test_blocking_and_classic(pytester: pytest.Pytester) -> None:
    source = """
    import pytest

    def test_blocking(blocking_vehicle, served_flight):
        blocking_vehicle.wait_ready()
        served_flight.faults.fail_prearm("Compass not healthy")
        with pytest.raises(Exception, match="Compass not healthy"):
            blocking_vehicle.arm()
        served_flight.track.assert_disarmed_at_end()

    def test_classic(dronekit, dronekit_address):
        import dronekit as same
        assert same is dronekit
        vehicle = dronekit.connect(dronekit_address, wait_ready=["armed"])
        assert vehicle.armed is False
        vehicle.close()

    def test_afterwards_the_name_is_free():
        import sys
        assert "dronekit" not in sys.modules
    """
    run(pytester, source).assert_outcomes(passed=3)


def test_invalid_use_is_explained(pytester: pytest.Pytester) -> None:
    source = """
    import pytest

    @pytest.mark.simulated("balloon")
    def test_kind(flight): ...

    @pytest.mark.simulated(count=2)
    def test_count(flight): ...

    def test_not_open(flight):
        flight.vehicle
    """
    result = run(pytester, source)
    result.assert_outcomes(errors=2, failed=1)
    reported = result.stdout.str()
    for text in ("'balloon' is not one of: copter", "use the fixture `fleet`", "flight.run(main)"):
        assert text in reported


def test_own_fixture_is_reported_once(pytester: pytest.Pytester) -> None:
    source = """
    import pytest
    from aerokit.testing import VIRTUAL_BACKEND, open_flight

    @pytest.fixture
    def anyio_backend():
        return VIRTUAL_BACKEND

    @pytest.fixture
    async def ready():
        async with open_flight() as flight:
            await flight.vehicle.wait_ready()
            yield flight

    @pytest.fixture
    def same(ready):
        return ready

    @pytest.mark.anyio
    async def test_it(ready, same):
        ready.track.assert_reached_altitude(10)
    """
    result = run(pytester, source)
    result.assert_outcomes(failed=1)
    assert result.stdout.str().count("system 1: STABILIZE, armed for 0.0 s") == 1


def test_other_projects_are_not_affected(pytester: pytest.Pytester) -> None:
    source = """
    import pytest, sys

    @pytest.fixture
    def flight():
        return "AF 447"

    def test_own_fixture(flight):
        assert flight == "AF 447"

    @pytest.mark.anyio
    async def test_async(flight):
        assert flight == "AF 447"
    """
    run(pytester, source, "-k", "not trio").assert_outcomes(passed=2)


def test_importing_it_is_cheap() -> None:
    program = (
        "import sys, pytest; before = set(sys.modules); import aerokit.testing.plugin;"
        " print(*set(sys.modules) - before)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    own = {name for name in done.stdout.split() if name.startswith("aerokit")}
    assert own == {
        "aerokit",
        "aerokit._internal",
        "aerokit._internal.imports",
        "aerokit.testing",
        "aerokit.testing.plugin",
    }
    assert "asyncio" not in done.stdout.split()


def test_aerokit_itself_is_not_rewritten() -> None:
    """Pytest rewrites every package with a plugin, which is slow and not thread-safe."""
    assert isinstance(aerokit.errors.__loader__, SourceFileLoader)
