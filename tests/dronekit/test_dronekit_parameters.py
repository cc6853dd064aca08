"""``vehicle.parameters``: the mapping, setting, listeners, waiting and failures."""

from __future__ import annotations

import logging
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from anyio.from_thread import start_blocking_portal
from flight_controller import FlightController, Received
from served_copter import served

from aerokit import dronekit
from aerokit.dronekit import parameters as parameters_module
from aerokit.errors import ParameterTimeout
from aerokit.parameters.renames import ParameterRenamedWarning
from aerokit.sim import SimulatedCopter, SimulatedPx4, open_simulator
from aerokit.vehicle.parameters.parameters import Parameters as AsyncParameters

LIMIT_S = 100.0
INT8, INT16 = 2, 4


@pytest.fixture
def fc() -> Iterator[FlightController]:
    with FlightController(heartbeat_s=0.02) as controller:
        yield controller


@contextmanager
def connected(fc: FlightController, **options: Any) -> Iterator[dronekit.Vehicle]:
    with dronekit.connect(fc.address, **{"rate": None, **options}) as vehicle:
        yield vehicle


@pytest.fixture
def vehicle(fc: FlightController) -> Iterator[dronekit.Vehicle]:
    fc.parameters.types = {"THR_MIN": INT16}
    with connected(fc, wait_ready=["parameters"]) as connected_vehicle:
        yield connected_vehicle


def wait_for_listeners(vehicle: dronekit.Vehicle) -> None:
    """Wait until all listeners have run."""
    vehicle._handler.loop.call(lambda: None)
    done = threading.Event()
    vehicle._handler.listener_thread.post(done.set)
    assert done.wait(LIMIT_S)


def notified(vehicle: dronekit.Vehicle, fc: FlightController, name: str, value: float, **more: Any) -> None:
    """Send a value from the flight controller, or from another ``source``, and wait until it is processed."""
    observed = threading.Event()

    def listener(*_: Any) -> None:
        observed.set()

    vehicle.add_message_listener("DEBUG", listener)
    wait_for_listeners(vehicle)
    if "source" in more:  # The report is of another sender, so the flight controller keeps its own value.
        more["param_value"] = value
    else:
        fc.parameters.values[name] = value
    fc.parameters.report(name, **more)
    fc.report("DEBUG", ind=1)
    assert observed.wait(LIMIT_S)
    vehicle.remove_message_listener("DEBUG", listener)
    wait_for_listeners(vehicle)


# ------------------------------------------------------------------------------------ the mapping


def test_parameters_mapping_methods(vehicle: dronekit.Vehicle) -> None:
    parameters = vehicle.parameters
    expected = {"FOO": 1.0, "BAR": 2.5, "THR_MIN": 130.0}
    assert dict(parameters) == expected == dict(parameters.items()) == dict(parameters.iteritems())
    assert list(parameters.keys()) == list(parameters.iterkeys()) == list(parameters.viewkeys()) == list(expected)
    assert list(parameters.values()) == list(parameters.itervalues()) == list(parameters.viewvalues())
    assert parameters.viewitems() == expected.items()
    assert ("foo", 1.0) in parameters.items()
    assert "foo" in parameters.keys()  # noqa: SIM118
    assert parameters.has_key("thr_min")
    assert not parameters.has_key("NOPE")
    assert 5 not in parameters  # type: ignore[comparison-overlap]
    assert isinstance(parameters["THR_MIN"], float)
    assert parameters.setdefault("FOO", 9) == 1.0
    assert vehicle._params_map == expected


def test_parameters_get_second_argument_is_not_default(vehicle: dronekit.Vehicle) -> None:
    assert vehicle.parameters.get("NOPE", 5) is None
    assert vehicle.parameters.get("NOPE", default=5) == 5
    assert vehicle.parameters.get("foo", False) == 1.0
    with pytest.raises(KeyError, match="NOPE"):
        vehicle.parameters["nope"]
    with pytest.raises(KeyError, match="A_NAME_THAT_NO_MESSAGE_CAN_CARRY"):
        vehicle.parameters["a_name_that_no_message_can_carry"]


def test_parameters_cannot_be_deleted(vehicle: dronekit.Vehicle) -> None:
    parameters = vehicle.parameters
    with pytest.raises(dronekit.APIException, match=r"^Cannot delete value from parameters list\.$"):
        del parameters["FOO"]
    with pytest.raises(dronekit.APIException):
        parameters.pop("FOO")
    with pytest.raises(dronekit.APIException):
        parameters.popitem()
    with pytest.raises(dronekit.APIException):
        parameters.clear()
    assert len(parameters) == 3


def test_parameters_iterate_during_download(vehicle: dronekit.Vehicle, fc: FlightController) -> None:
    names, items = iter(vehicle.parameters), iter(vehicle.parameters.items())
    assert (next(names), next(items)) == ("FOO", ("FOO", 1.0))
    notified(vehicle, fc, "NEW", 5.0)
    assert len(list(names)) == len(list(items)) == 2
    assert len(vehicle.parameters) == 4


# ---------------------------------------------------------------------------------------- setting


def test_integer_parameters_cut_off_fractions(vehicle: dronekit.Vehicle, fc: FlightController) -> None:
    parameters = vehicle.parameters
    parameters["thr_min"] = 99.7
    assert parameters["THR_MIN"] == 99.0
    assert parameters.set("THR_MIN", -1.999)
    assert parameters.set("THR_MIN", True)
    assert parameters["THR_MIN"] == 1.0
    parameters.update({"FOO": 7}, bar=8)
    sent = [(frame.param_id, frame.param_value, frame.param_type) for frame in fc.received("PARAM_SET")]
    assert sent[0] == ("THR_MIN", 99.0, INT16)
    assert ("THR_MIN", -2.0, INT16) in sent
    assert ("BAR", 8.0, 9) in sent


def test_parameter_set_unchanged_value_is_confirmed(vehicle: dronekit.Vehicle, fc: FlightController) -> None:
    assert vehicle.parameters.set("FOO", 1)
    fc.wait_for("PARAM_SET")
    fc.parameters.values["FOO"] = 2.0  # without a message
    assert vehicle.parameters.set("FOO", 1)
    assert fc.parameters.values["FOO"] == 1.0


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("FOO", 50, "FOO to 50.000000: the vehicle set 10 instead"),
        ("NOPE", 1, "NOPE to 1.000000: the vehicle has no parameter NOPE"),
        ("A_NAME_OF_MANY_LETTERS", 1, "1 to 16 are possible"),
        ("THR_MIN", 40000, "-32768..32767"),
        ("THR_MIN", float("inf"), "finite"),
        ("FOO", float("nan"), "FOO to nan: "),
    ],
)
def test_rejected_parameter_returns_false_and_logs_error(
    vehicle: dronekit.Vehicle,
    fc: FlightController,
    caplog: pytest.LogCaptureFixture,
    *,
    name: str,
    value: float,
    reason: str,
) -> None:
    fc.parameters.adjust = lambda _, wanted: min(wanted, 10.0)
    assert not vehicle.parameters.set(name, value)
    vehicle.parameters[name] = value
    records = [record for record in caplog.records if record.levelno == logging.ERROR]
    assert len(records) == 2
    assert f"could not set parameter {name} to " in records[0].getMessage()
    assert reason in records[0].getMessage()


@pytest.mark.parametrize("value", ["1", None, [1]])
def test_parameter_set_non_number_raises(vehicle: dronekit.Vehicle, fc: FlightController, value: Any) -> None:
    with pytest.raises(ValueError, match=r"FOO = .* is not a number"):
        vehicle.parameters["FOO"] = value
    with pytest.raises(ValueError, match="is not a string"):
        vehicle.parameters.set(5, 5)  # type: ignore[arg-type]
    assert not fc.received("PARAM_SET")


def test_parameters_accept_numpy_numbers(vehicle: dronekit.Vehicle) -> None:
    class Float:
        def __float__(self) -> float:
            return 4.5

    class Integer:
        def __index__(self) -> int:
            return 4

    assert vehicle.parameters.set("FOO", Float())  # type: ignore[arg-type]
    assert vehicle.parameters["FOO"] == 4.5
    assert vehicle.parameters.set("FOO", Integer())  # type: ignore[arg-type]
    assert vehicle.parameters["FOO"] == 4.0


def test_parameter_set_without_retries_returns_immediately(vehicle: dronekit.Vehicle, fc: FlightController) -> None:
    assert vehicle.parameters.set("FOO", 6, retries=0) is False
    fc.wait_for("PARAM_SET", lambda frame: frame.param_value == 6)
    vehicle.close()
    assert vehicle.parameters["FOO"] == 6.0


def test_failed_parameter_set_without_retries_is_logged(
    vehicle: dronekit.Vehicle, caplog: pytest.LogCaptureFixture
) -> None:
    vehicle.parameters.set("FOO", float("nan"), retries=0)
    vehicle.wait_for(lambda: "parameter FOO: FOO = nan must be a finite number" in caplog.text, LIMIT_S, 0.01)


def test_parameter_set_in_listener(vehicle: dronekit.Vehicle, fc: FlightController) -> None:
    results: list[object] = []
    done = threading.Event()

    def listener(parameters: dronekit.Parameters, name: str, value: float) -> None:
        results.append((name, value, parameters.set("FOO", value + 1), parameters["FOO"]))
        done.set()

    vehicle.parameters.add_attribute_listener("BAR", listener)
    notified(vehicle, fc, "BAR", 30.0)
    assert done.wait(LIMIT_S)
    assert results == [("BAR", 30.0, True, 31.0)]


# -------------------------------------------------------------------------------------- listening


def test_parameter_listeners_are_called_once_per_parameter(fc: FlightController) -> None:
    with connected(fc, _initialize=False) as vehicle:
        observed: list[tuple[object, str, object]] = []
        vehicle.parameters.add_attribute_listener("*", lambda *event: observed.append(event))
        is_complete = threading.Event()

        @vehicle.on_attribute("parameters")
        def on_parameters(*event: Any) -> None:
            observed.append(event)
            is_complete.set()

        vehicle.initialize(rate=None)
        vehicle.parameters.wait_ready()
        assert is_complete.wait(LIMIT_S)
        parameters = vehicle.parameters
        assert observed[:-1] == [
            (parameters, "FOO", 1.0),
            (parameters, "BAR", 2.5),
            (parameters, "THR_MIN", 130.0),
        ]
        assert observed[-1] == (vehicle, "parameters", parameters)
        notified(vehicle, fc, "FOO", 1.0)
        assert len(observed) == 4
        notified(vehicle, fc, "FOO", 2.0)
        assert observed[4:] == [(parameters, "FOO", 2.0)]


def test_parameter_listener_names_are_upper_cased(vehicle: dronekit.Vehicle, fc: FlightController) -> None:
    observed: list[str] = []
    parameters = vehicle.parameters

    @parameters.on_attribute(["foo", "Bar"])
    def listener(_: object, name: str, value: float) -> None:
        observed.append(name)

    notified(vehicle, fc, "FOO", 2.0)
    notified(vehicle, fc, "BAR", 2.0)
    parameters.remove_attribute_listener("bar", listener)
    notified(vehicle, fc, "BAR", 3.0)
    assert observed == ["FOO", "BAR"]
    parameters.notify_attribute_listeners("foo", 17.0)
    parameters.notify_attribute_listeners("foo", 17.0)
    assert observed == ["FOO", "BAR", "FOO", "FOO"]
    parameters.notify_attribute_listeners("foo", 18.0, cache=True)
    parameters.notify_attribute_listeners("foo", 18.0, True)
    assert observed == ["FOO", "BAR", *["FOO"] * 3]


def test_parameter_decorator_argument_name(vehicle: dronekit.Vehicle, fc: FlightController) -> None:
    observed: list[str] = []
    vehicle.parameters.on_attribute(attr_name="foo")(lambda _, name, value: observed.append(name))
    notified(vehicle, fc, "FOO", 2.0)
    assert observed == ["FOO"]


def test_old_parameter_names_work_on_new_firmware(fc: FlightController) -> None:
    fc.parameters.values = {"LOIT_SPEED": 500.0, "MOT_SPIN_MIN": 0.125, "GPS1_TYPE": 1.0}
    with connected(fc, wait_ready=["parameters"]) as vehicle:
        for name, value, new in [
            ("WPNAV_LOIT_SPEED", 500, "LOIT_SPEED"),
            ("THR_MIN", 125, "MOT_SPIN_MIN"),
            ("GPS_TYPE", 1, "GPS1_TYPE"),
        ]:
            with pytest.warns(ParameterRenamedWarning, match=new):
                assert vehicle.parameters[name] == value
        with pytest.warns(ParameterRenamedWarning, match="MOT_SPIN_MIN"):
            vehicle.parameters["THR_MIN"] = 250
        assert fc.parameters.values["MOT_SPIN_MIN"] == 0.25
        with pytest.raises(KeyError, match="FLOW_ENABLE: replaced by FLOW_TYPE"):
            vehicle.parameters["FLOW_ENABLE"]


def test_parameters_without_listeners_queue_nothing(fc: FlightController) -> None:
    with connected(fc, wait_ready=["parameters"]) as vehicle:
        assert vehicle._handler.listener_thread._thread is None


def test_parameters_of_other_components_are_ignored(vehicle: dronekit.Vehicle, fc: FlightController) -> None:
    own = dict(vehicle.parameters)
    notified(vehicle, fc, "FOO", 66.0, source=(1, 154), param_count=900)
    notified(vehicle, fc, "FOO", 67.0, source=(42, 1))
    notified(vehicle, fc, "ZOOM", 68.0, source=(1, 154))
    assert dict(vehicle.parameters) == own


# ---------------------------------------------------------------------------------------- waiting


def test_single_parameter_is_read_before_list_completes(fc: FlightController) -> None:

    def only_by_name(frame: Received) -> None:
        if frame.param_id:
            fc.parameters.report(frame.param_id)

    fc.answers["PARAM_REQUEST_LIST"] = lambda _: None
    fc.answers["PARAM_REQUEST_READ"] = only_by_name
    with connected(fc) as vehicle:
        assert vehicle.parameters["bar"] == 2.5
        assert "FOO" in vehicle.parameters
        assert vehicle.parameters.get("THR_MIN", wait_ready=False) is None
        assert vehicle.parameters.set("FOO", 140)
        assert not vehicle.wait_ready("parameters", timeout=0.05, raise_exception=False)


def test_vehicle_without_parameters(fc: FlightController, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parameters_module, "WAIT_TIMEOUT_S", 0.2)
    fc.parameters.is_silent = True
    with connected(fc, wait_ready=False) as vehicle:
        parameters = vehicle.parameters
        assert len(parameters) == 0
        assert parameters.get("FOO", wait_ready=False) is None
        with pytest.raises(dronekit.TimeoutError, match=r"^wait_ready experienced a timeout after 0 seconds\.$"):
            parameters["FOO"]
        with pytest.raises(TimeoutError, match=r"^wait_ready experienced a timeout after 0.1 seconds\.$"):
            parameters.wait_ready(timeout=0.1)
        fc.parameters.is_silent = False
        parameters.wait_ready()
        assert parameters["FOO"] == 1.0


def test_failed_parameter_download_is_repeated_while_waiting(
    fc: FlightController, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("aerokit.dronekit.parameters.RETRY_DELAY_S", 0.01)
    download, attempts = AsyncParameters.download, []

    async def fail_twice(parameters: AsyncParameters, **options: Any) -> Any:
        attempts.append(options)
        if len(attempts) < 3:
            raise ParameterTimeout("2 of 3 parameters are missing", missing=(1, 2))
        return await download(parameters, **options)

    monkeypatch.setattr(AsyncParameters, "download", fail_twice)
    with connected(fc, wait_ready=["parameters"]) as vehicle:
        assert len(attempts) == 3
        assert dict(vehicle.parameters) == {"FOO": 1.0, "BAR": 2.5, "THR_MIN": 130.0}
    lines = [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]
    assert lines == ["the parameters could not be downloaded: 2 of 3 parameters are missing"]


def test_unanswered_parameter_waits_for_list(fc: FlightController) -> None:
    fc.answers["PARAM_REQUEST_READ"] = lambda _: None
    with connected(fc) as vehicle:
        assert vehicle.parameters["THR_MIN"] == 130.0
        assert "NOPE" not in vehicle.parameters
        assert vehicle.parameters.known_values().keys() == {"FOO", "BAR", "THR_MIN"}


def test_connection_end_while_reading_parameter_raises(fc: FlightController) -> None:
    fc.parameters.is_silent = True
    with connected(fc) as vehicle:
        handler = vehicle._handler

        def close(_: Received) -> None:
            fc.answers["PARAM_REQUEST_READ"] = lambda _: None
            handler.loop.call_soon(handler.connection.close)

        fc.answers["PARAM_REQUEST_READ"] = close
        with pytest.raises(dronekit.APIException, match="closed"):
            vehicle.parameters["FOO"]


def test_parameters_added_later_are_found(vehicle: dronekit.Vehicle, fc: FlightController) -> None:
    assert "NEW" not in vehicle.parameters
    fc.parameters.values["NEW"] = 5.0
    assert vehicle.parameters.set("FOO", 3)  # the answer contains a count of four
    assert vehicle.parameters["new"] == 5.0
    assert "NOPE" not in vehicle.parameters


def test_parameters_survive_reboot_and_lost_link(vehicle: dronekit.Vehicle, fc: FlightController) -> None:
    vehicle._handler.loop.call(vehicle.aio._session._on_reboot)
    parameters = vehicle.parameters
    assert parameters["FOO"] == 1.0
    assert parameters.set("FOO", 2)
    assert "NOPE" not in parameters
    vehicle.close()
    assert dict(parameters) == {"FOO": 2.0, "BAR": 2.5, "THR_MIN": 130.0}
    assert parameters.get("NOPE") is None
    with pytest.raises(dronekit.APIException, match="closed"):
        parameters["FOO"] = 3


def test_parameters_before_connecting_raise(fc: FlightController) -> None:
    with connected(fc, _initialize=False) as vehicle:
        assert vehicle.parameters.get("FOO", False) is None
        assert len(vehicle.parameters) == 0
        with pytest.raises(dronekit.APIException, match="not connected"):
            vehicle.parameters["FOO"]
        with pytest.raises(dronekit.APIException, match="not connected"):
            vehicle.parameters["FOO"] = 1


# ------------------------------------------------------------------------- the simulated vehicles


@pytest.fixture
def copter() -> SimulatedCopter:
    return SimulatedCopter(boot_time_s=0.0)


def test_parameters_of_simulated_copter(copter: SimulatedCopter) -> None:
    with served([copter]) as address, dronekit.connect(address, wait_ready=["parameters"]) as vehicle:
        parameters = vehicle.parameters
        assert dict(parameters) == {name: float(copter.parameters[name]) for name in copter.parameters}
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert parameters.set("RTL_ALT", 3000)
        assert copter.parameters["RTL_ALT"] == parameters["RTL_ALT"] == 3000


def test_renamed_parameters_are_converted(copter: SimulatedCopter) -> None:
    own, other, factor = ("WPNAV_SPEED", "WP_SPD", 0.01)
    if own not in copter.parameters:
        own, other, factor = other, own, 100.0
    with served([copter]) as address, dronekit.connect(address, wait_ready=["parameters"]) as vehicle:
        parameters = vehicle.parameters
        assert other in parameters
        with pytest.warns(ParameterRenamedWarning, match=own) as caught:
            assert parameters[other] == pytest.approx(copter.parameters[own] * factor)
        assert caught[0].filename == __file__
        with pytest.warns(ParameterRenamedWarning):
            assert parameters.set(other, 700 * factor)
        assert parameters[own] == copter.parameters[own] == pytest.approx(700)
        assert other not in list(parameters)


def test_parameters_include_download_by_aio(copter: SimulatedCopter) -> None:
    with served([copter]) as address, dronekit.connect(address, wait_ready=["parameters"]) as vehicle:
        observed: list[object] = []
        vehicle.parameters.add_attribute_listener("RTL_ALT", lambda *event: observed.append(event))
        copter.parameters["RTL_ALT"] = 4321.0
        vehicle.run(vehicle.aio.parameters.download, refresh=True)
        wait_for_listeners(vehicle)
        assert vehicle.parameters["RTL_ALT"] == 4321.0
        assert observed == [(vehicle.parameters, "RTL_ALT", 4321.0)]


def test_px4_integer_parameters() -> None:
    px4 = SimulatedPx4()
    with (
        start_blocking_portal() as portal,
        portal.wrap_async_context_manager(open_simulator([px4], "tcpin:127.0.0.1:0", speedup=20.0)) as simulator,
    ):
        address = simulator.addresses[0].replace("tcpin:", "tcp:")
        with dronekit.connect(address, wait_ready=["parameters"]) as vehicle:
            parameters = vehicle.parameters
            assert parameters["CAL_ACC0_ID"] == px4.parameters["CAL_ACC0_ID"] > 1e6
            parameters["cal_acc0_prio"] = 75.0
            assert px4.parameters["CAL_ACC0_PRIO"] == parameters["CAL_ACC0_PRIO"] == 75
            assert "NOPE" not in parameters
