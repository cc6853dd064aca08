"""Parameters for programs without ``async``: the blocks, and Ctrl-C out of them."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Iterator

import pytest
from ctrl_c import interrupt_soon
from served_copter import served

import aerokit.sync
from aerokit.errors import InvalidArgument, ParameterRejected, RollbackFailed
from aerokit.events import SettingChanged
from aerokit.sim import SimulatedCamera, SimulatedCopter
from aerokit.sync.twins import Settings


@pytest.fixture
def copter() -> SimulatedCopter:
    return SimulatedCopter(boot_time_s=0.0, parameter_count=100)


@pytest.fixture
def vehicle(copter: SimulatedCopter) -> Iterator[aerokit.sync.Vehicle]:
    with served([copter]) as address, aerokit.sync.connect(address) as vehicle:
        yield vehicle


def test_parameters_are_read_and_written(vehicle: aerokit.sync.Vehicle) -> None:
    parameters = vehicle.parameters
    assert len(parameters.download()) == len(parameters.table) == 100
    assert parameters.set("RTL_ALT", 2000).outcome == "set"
    assert parameters.get("RTL_ALT") == parameters.read("RTL_ALT").value == 2000
    assert [difference.name for difference in parameters.diff({"RTL_ALT": 1500, "LAND_SPEED": 50})] == ["RTL_ALT"]
    assert "RTL_ALT" in parameters.changed_from_default()
    assert parameters.upload({"RTL_ALT": 1500})["RTL_ALT"].value == 1500
    assert parameters.set_many({"NO_SUCH_ONE": 1})["NO_SUCH_ONE"].outcome == "failed"


def test_parameter_blocks_restore_values(vehicle: aerokit.sync.Vehicle, copter: SimulatedCopter) -> None:
    with vehicle.parameters.temporarily({"RTL_ALT": 2000}) as results:
        assert results["RTL_ALT"].value == copter.parameters["RTL_ALT"] == 2000
    assert copter.parameters["RTL_ALT"] == 1500
    with pytest.raises(ParameterRejected), vehicle.parameters.transaction() as transaction:
        transaction.set("RTL_ALT", 2000)
        assert [change.name for change in transaction.changes] == ["RTL_ALT"]
        transaction.set("NO_SUCH_ONE", 1)
    assert copter.parameters["RTL_ALT"] == 1500


def test_vehicle_closed_in_block_names_unrestored_values(vehicle: aerokit.sync.Vehicle) -> None:
    with pytest.raises(RollbackFailed) as raised, vehicle.parameters.temporarily({"RTL_ALT": 2000}):
        vehicle.close()
    assert raised.value.not_restored == {"RTL_ALT": 1500}


def test_vehicle_closed_in_successful_transaction_is_no_error(vehicle: aerokit.sync.Vehicle) -> None:
    with vehicle.parameters.transaction() as transaction:
        transaction.set("RTL_ALT", 2000)
        vehicle.close()


@pytest.mark.skipif(not hasattr(signal, "pthread_kill"), reason="needs POSIX signals")
def test_ctrl_c_in_block_restores_values(vehicle: aerokit.sync.Vehicle, copter: SimulatedCopter) -> None:
    main = threading.main_thread().ident
    assert main is not None
    with pytest.raises(KeyboardInterrupt), vehicle.parameters.temporarily({"RTL_ALT": 2000}):
        signal.pthread_kill(main, signal.SIGINT)
        time.sleep(10)
    assert copter.parameters["RTL_ALT"] == 1500


@pytest.mark.skipif(not hasattr(signal, "pthread_kill"), reason="needs POSIX signals")
def test_ctrl_c_during_restore_waits_for_it(vehicle: aerokit.sync.Vehicle, copter: SimulatedCopter) -> None:
    def back() -> None:
        copter.faults.silent = False

    radio = threading.Timer(0.5, back)
    with pytest.raises(KeyboardInterrupt), vehicle.parameters.temporarily({"RTL_ALT": 2000}):
        copter.faults.silent = True
        radio.start()
        interrupt_soon()
    radio.join()
    assert copter.parameters["RTL_ALT"] == 1500


@pytest.mark.skipif(not hasattr(signal, "pthread_kill"), reason="needs POSIX signals")
def test_ctrl_c_does_not_hide_restore_errors(vehicle: aerokit.sync.Vehicle, copter: SimulatedCopter) -> None:
    with (
        pytest.raises(KeyboardInterrupt) as interrupted,
        vehicle.parameters.temporarily({"RTL_ALT": 2000}, idle_timeout_s=1.0),
    ):
        copter.faults.silent = True
        interrupt_soon()
    failed = interrupted.value.__cause__
    assert isinstance(failed, RollbackFailed)
    assert failed.not_restored == {"RTL_ALT": 1500}


def test_camera_settings() -> None:
    camera = SimulatedCamera()
    with (
        served([SimulatedCopter(boot_time_s=0.0, components=[camera])]) as address,
        aerokit.sync.connect(address) as vehicle,
    ):
        settings = vehicle.component(100).settings
        assert isinstance(settings, Settings)
        assert settings.fetch_definition().model == "Simulated camera"
        assert len(settings.download()) == len(settings.table) == 12
        assert settings.set("CAM_WBMODE", "Sunny").value == settings.get("CAM_WBMODE") == 4
        assert settings.options("CAM_WBMODE") == {"Auto": 0, "Sunny": 4, "Cloudy": 5}
        assert settings.excluded_by("CAM_ISO") == ("CAM_EXPMODE = Auto",)
        with pytest.raises(InvalidArgument, match="excluded by"):
            settings.set("CAM_ISO", 400)
        with vehicle.subscribe(SettingChanged, capacity=4) as changes:
            settings.set("CAM_OWNER", "me")
            assert changes.get(timeout=100).after == "me"
        assert vehicle.component(100).files.read("/camera_definition.xml").startswith(b"<?xml")
