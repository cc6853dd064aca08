"""``vehicle.channels`` and their overrides."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from dronekit_stage import Stage, on_stage
from flight_controller import FlightController, message_of

from aerokit import dronekit
from aerokit.dronekit.channels import Channels

SOURCES = Path(__file__).parent.parent.parent / "src"
IGNORED, RELEASED = 0xFFFF, 0xFFFE
VALUES = {f"chan{number}_raw": 1000 + number for number in range(1, 19)}
FIRST_VALUES = {f"chan{number}_raw": 1000 + number for number in range(1, 9)}
REPORTED = {str(number): 1000 + number for number in range(1, 9)}


@pytest.fixture
def stage() -> Iterator[Stage]:
    with on_stage(dronekit, connect={"rate": None}) as stage:
        yield stage


@pytest.fixture
def channels(stage: Stage) -> Channels:
    value: Channels = stage.vehicle.channels
    return value


def sent(stage: Stage, action: Callable[[], object]) -> list[tuple[int, ...]]:
    """Return the RC_CHANNELS_OVERRIDE messages of an action, without trailing zeros."""
    messages = []
    for frame in stage.sent_by(action, "RC_CHANNELS_OVERRIDE"):
        assert frame.target == (1, 0)
        values = [getattr(frame, f"chan{number}_raw") for number in range(1, 19)]
        while values and values[-1] == 0:
            values.pop()
        messages.append(tuple(values))
    return messages


# ------------------------------------------------------------------------------------ channels


def test_channels_are_eight_before_first_message(channels: Channels) -> None:
    assert channels == {str(number): None for number in range(1, 9)}
    assert len(channels) == channels.count == 8


def test_rc_channels_updates_channels_and_notifies(stage: Stage, channels: Channels) -> None:
    events = stage.listen("channels")
    stage.report("RC_CHANNELS", chancount=16, **{**VALUES, "chan3_raw": 0, "chan8_raw": IGNORED})
    assert channels == {**REPORTED, "3": 0, "8": None}
    assert [name for _, name, _ in events] == ["channels"]


def test_rc_channels_raw_port_1_gives_sixteen_channels(stage: Stage, channels: Channels) -> None:
    stage.report("RC_CHANNELS_RAW", port=0, **FIRST_VALUES)
    assert channels == REPORTED
    stage.report("RC_CHANNELS_RAW", port=1, **{**FIRST_VALUES, "chan1_raw": 1900})
    assert len(channels) == 16
    assert channels[9] == channels["9"] == 1900
    assert channels["1"] == 1001
    stage.report("RC_CHANNELS_RAW", port=2, **FIRST_VALUES)
    assert len(channels) == 16


def test_channels_count_increases_channels(stage: Stage, channels: Channels) -> None:
    channels.count = 18
    assert channels.get("18", 0) is None
    stage.report("RC_CHANNELS", chancount=18, **VALUES)
    assert channels["18"] == 1018
    channels.count = 8
    assert channels == REPORTED
    for count in (7, 19):
        with pytest.raises(ValueError, match="8 to 18"):
            channels.count = count


def test_channel_keys_are_strings_or_integers(channels: Channels) -> None:
    assert channels[1] is None
    assert 8 in channels
    assert "8" in channels
    assert channels.has_key(8)
    assert 9 not in channels
    assert channels.get(9, 5) == 5
    with pytest.raises(KeyError, match="9"):
        channels["9"]


def test_channels_have_python_2_methods(channels: Channels) -> None:
    assert list(channels.iterkeys()) == list(channels.viewkeys()) == list(channels)
    assert list(channels.itervalues()) == list(channels.viewvalues()) == [None] * 8
    assert dict(channels.iteritems()) == dict(channels.viewitems()) == channels.copy() == channels
    assert Channels.fromkeys("ab", 1) == {"a": 1, "b": 1}


def test_channels_are_read_only(channels: Channels) -> None:
    changes: tuple[Callable[[Any], object], ...] = (
        lambda channels: channels.__setitem__("1", 1),
        lambda channels: channels.__delitem__("1"),
        lambda channels: channels.__ior__({"1": 1}),
        lambda channels: channels.update({"1": 1}),
        lambda channels: channels.setdefault("1", 1),
        lambda channels: channels.pop("1"),
        lambda channels: channels.popitem(),
        lambda channels: channels.clear(),
    )
    for change in changes:
        with pytest.raises(TypeError, match="is not supported on Channels object"):
            change(channels)
    assert len(channels) == 8


def test_channels_readers_see_values_of_one_message(stage: Stage, channels: Channels) -> None:
    torn, ended = [], threading.Event()

    def read() -> None:
        while not ended.is_set():
            for values in (set(channels.values()), {value for _, value in channels.items()}):
                if len(values) != 1:
                    torn.append(values)

    reader = threading.Thread(target=read)
    reader.start()
    for value in range(1000, 1100):
        stage.fc.send(message_of("RC_CHANNELS", **dict.fromkeys(VALUES, value)))
    stage.settle()
    ended.set()
    reader.join()
    assert not torn


# ----------------------------------------------------------------------------------- overrides


def test_overrides_each_change_is_sent(stage: Stage, channels: Channels) -> None:
    overrides = channels.overrides
    assert sent(stage, lambda: overrides.__setitem__("2", 200)) == [(0, 200)]
    assert sent(stage, lambda: overrides.__setitem__(3, 1500)) == [(0, 200, 1500)]
    assert sent(stage, lambda: overrides.__delitem__("3")) == [(0, 200)]
    assert sent(stage, lambda: overrides.__setitem__("2", None)) == [()]
    assert sent(stage, lambda: overrides.__setitem__("2", 0)) == [()]
    assert sent(stage, lambda: setattr(channels, "overrides", {"5": None, 3: 500})) == [(0, 0, 500)]
    assert channels.overrides is overrides
    assert overrides == {"3": 500}
    assert sent(stage, lambda: setattr(channels, "overrides", {})) == [()]
    assert overrides == {}


def test_overrides_dict_methods_send(stage: Stage, channels: Channels) -> None:
    overrides = channels.overrides
    assert sent(stage, lambda: overrides.update({"1": 1100}, **{"2": 1200})) == [(1100, 1200)]
    assert sent(stage, lambda: overrides.setdefault(3, 1300)) == [(1100, 1200, 1300)]
    assert sent(stage, lambda: overrides.setdefault("3", 1400)) == []
    assert sent(stage, lambda: overrides.pop(2)) == [(1100, 0, 1300)]
    assert sent(stage, lambda: overrides.pop("2", None)) == []
    assert sent(stage, lambda: overrides.popitem()) == [(1100,)]
    assert sent(stage, lambda: overrides.__ior__({4: 1400})) == [(1100, 0, 0, 1400)]
    assert sent(stage, overrides.clear) == [()]
    with pytest.raises(KeyError):
        overrides.pop("2")
    with pytest.raises(KeyError):
        overrides.popitem()


def test_overrides_len_counts_overridden_channels(channels: Channels) -> None:
    overrides = channels.overrides
    assert not overrides
    assert len(overrides) == 0
    overrides["3"] = 1500
    assert len(overrides) == 1
    assert 3 in overrides
    assert "3" in overrides
    assert overrides.get(3) == overrides[3] == overrides["3"] == 1500
    assert str(overrides) == "{'3': 1500}"
    assert overrides.has_key("3")
    with pytest.raises(KeyError, match="2"):
        overrides["2"]


@dataclass(frozen=True)
class Int64:
    """An integer like numpy's: not an int, but usable as one."""

    value: int

    def __round__(self) -> Int64:
        return self

    def __int__(self) -> int:
        return self.value

    def __le__(self, other: int) -> bool:
        return self.value <= other

    def __ge__(self, other: int) -> bool:
        return self.value >= other


def test_overrides_round_fractions_and_numpy_numbers(stage: Stage, channels: Channels) -> None:
    numbers: dict[str, Any] = {"1": 1523.7, "2": Int64(1400), "3": 1500.0}

    def override() -> None:
        channels.overrides = numbers

    assert sent(stage, override) == [(1524, 1400, 1500)]
    assert channels.overrides == {"1": 1524, "2": 1400, "3": 1500}


WRONG: tuple[tuple[dict[str, Any], type[Exception], str], ...] = (
    ({"9": 900}, KeyError, "Invalid channel index 9"),
    ({"0": 900}, KeyError, "Invalid channel index 0"),
    ({"x": 900}, ValueError, "'x'"),
    ({"2": 1200, "3": 70000}, ValueError, "channel 3 = 70000 is not allowed"),
    ({"3": -1}, ValueError, "channel 3 = -1"),
    ({"3": float("inf")}, ValueError, "channel 3 = inf"),
    ({"3": float("nan")}, ValueError, "channel 3 = nan"),
    ({"3": "1500"}, ValueError, "channel 3 = '1500'"),
)


def test_overrides_invalid_values_change_nothing(stage: Stage, channels: Channels) -> None:
    channels.overrides["1"] = 1100
    stage.reached()

    def order() -> None:
        for change in (channels.overrides.update, channels.overrides._replace):
            for wrong, kind, text in WRONG:
                with pytest.raises(kind, match=text):
                    change(wrong)

    assert sent(stage, order) == []
    assert channels.overrides == {"1": 1100}
    assert sent(stage, lambda: channels.overrides.__setitem__("2", 1200)) == [(1100, 1200)]


def test_overrides_delete_missing_channel_raises(stage: Stage, channels: Channels) -> None:
    def order() -> None:
        with pytest.raises(KeyError, match="3"):
            del channels.overrides["3"]

    assert sent(stage, order) == []


def test_channels_above_eight_are_untouched_until_overridden(stage: Stage, channels: Channels) -> None:
    channels.count = 18
    overrides = channels.overrides
    assert sent(stage, lambda: overrides.__setitem__("10", 1900)) == [(*(0,) * 9, 1900)]
    assert sent(stage, lambda: overrides.__delitem__("10")) == [(*(0,) * 9, RELEASED)]
    assert sent(stage, lambda: overrides.__setitem__(1, 1100)) == [(1100, *(0,) * 8, RELEASED)]
    assert sent(stage, lambda: overrides.__setitem__(18, 1200)) == [(1100, *(0,) * 8, RELEASED, *(0,) * 7, 1200)]


def test_overrides_with_mavlink_1_allow_eight_channels() -> None:
    with on_stage(dronekit, {"version": 1}, {"rate": None}, _knows_only_mavlink_1) as stage:
        channels = stage.vehicle.channels
        assert sent(stage, lambda: channels.overrides.__setitem__("2", 200)) == [(0, 200)]
        channels.count = 16
        with pytest.raises(dronekit.APIException, match="MAVLink 1"):
            channels.overrides["9"] = 1500
        assert channels.overrides == {"2": 200}


def _knows_only_mavlink_1(controller: Any) -> None:
    controller.capabilities &= ~8192


def test_overrides_after_close_raise(stage: Stage, channels: Channels) -> None:
    stage.vehicle.close()
    with pytest.raises(dronekit.APIException):
        channels.overrides["1"] = 1500
    assert channels.overrides == {}


# ------------------------------------------------------------------------- the end of overrides

OURS = {"1": 1500, "3": 1900, "10": 1700}


def released(fc: FlightController, since: int) -> list[tuple[int, ...]]:
    """Return the channels of each RC_CHANNELS_OVERRIDE that releases channel 3."""
    fc.wait_for("RC_CHANNELS_OVERRIDE", lambda frame: frame.chan3_raw == 0, since=since)
    return [
        tuple(getattr(frame, f"chan{number}_raw") for number in range(1, 19))
        for frame in fc.received("RC_CHANNELS_OVERRIDE", since=since)
        if frame.chan3_raw == 0
    ]


RELEASED_OVERRIDES = (0, IGNORED, 0, *(IGNORED,) * 5, 0, RELEASED, *(0,) * 8)


def test_overrides_are_released_on_close(stage: Stage, channels: Channels) -> None:
    channels.count = 18
    channels.overrides = OURS
    stage.reached()
    since = stage.fc.mark()
    stage.vehicle.close()
    assert set(released(stage.fc, since)) == {RELEASED_OVERRIDES}


def test_overrides_sent_by_send_mavlink_are_released_on_close(stage: Stage) -> None:
    values = [1500, IGNORED, 1900, *(IGNORED,) * 5, IGNORED, 1700]
    stage.vehicle.send_mavlink(stage.vehicle.message_factory.rc_channels_override_encode(0, 0, *values))
    stage.reached()
    since = stage.fc.mark()
    stage.vehicle.close()
    assert set(released(stage.fc, since)) == {RELEASED_OVERRIDES}


@pytest.mark.parametrize("has_overridden", [False, True], ids=["never", "given back before"])
def test_close_without_overrides_sends_no_release_message(
    stage: Stage, channels: Channels, has_overridden: bool
) -> None:
    if has_overridden:
        channels.count = 18
        channels.overrides = OURS
        channels.overrides.clear()
    stage.reached()
    since = stage.fc.mark()
    stage.vehicle.close()
    assert stage.fc.received("RC_CHANNELS_OVERRIDE", since=since) == []


def test_release_overrides_false_sends_no_release() -> None:
    with on_stage(dronekit, connect={"release_overrides": False}) as stage:
        stage.vehicle.channels.overrides = {"3": 1900}
        stage.reached()
        since = stage.fc.mark()
        stage.vehicle.close()
        assert stage.fc.received("RC_CHANNELS_OVERRIDE", since=since) == []


ENDS = {
    "end of the program": "",
    "exception": "raise ValueError",
    "sys.exit": "import sys; sys.exit(3)",
    "SIGINT": "import os, signal; os.kill(os.getpid(), signal.SIGINT)",
    "SIGTERM turned into an exit": (
        "import os, signal, sys; signal.signal(signal.SIGTERM, lambda *_: sys.exit(143));"
        " os.kill(os.getpid(), signal.SIGTERM)"
    ),
    "dropped": "import gc; del vehicle; gc.collect(); time.sleep(0.5)",
}


@pytest.mark.sampled(3)
@pytest.mark.parametrize("end", ENDS.values(), ids=ENDS)
def test_overrides_are_released_at_program_exit(end: str) -> None:
    program = f"""
import time
from aerokit import dronekit

vehicle = dronekit.connect({{address!r}}, rate=None)
vehicle.channels.overrides = {{{{"1": 1500, "3": 1900}}}}
time.sleep(0.1)
{end}
"""
    with FlightController() as fc:
        since = fc.mark()
        subprocess.run(
            [sys.executable, "-c", program.format(address=fc.address)],
            env={**os.environ, "PYTHONPATH": str(SOURCES)},
            timeout=200,
            check=False,
        )
        assert set(released(fc, since)) == {(0, IGNORED, 0, *(IGNORED,) * 5, *(0,) * 10)}
