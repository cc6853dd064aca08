"""RC channels and calibrations of a simulated ArduCopter, as measured on ArduCopter 4.7 in SITL."""

from __future__ import annotations

import pytest
from simulated_client import Client, ready_copter

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavCmd, MavDataStream, MavResult
from aerokit.mavlink.framer import Framer
from aerokit.sim import SimulatedCopter

RESTING = (1500, 1500, 1000, 1500, 1800, 1000, 1000, 1800)
SAME, RELEASE = 0xFFFF, 0xFFFE
ACCEPTED, FAILED = MavResult.ACCEPTED, MavResult.FAILED
REJECTED = MavResult.TEMPORARILY_REJECTED


def channels(client: Client) -> tuple[int, ...]:
    assert client.command(MavCmd.REQUEST_MESSAGE, m.RcChannels.ID) == ACCEPTED
    client.run(0.05)
    message = client.last(m.RcChannels)
    assert message.chancount == 8
    return tuple(getattr(message, f"chan{number}_raw") for number in range(1, 19))


def override(client: Client, *values: int) -> None:
    client.send(m.RcChannelsOverride(1, 1, *values, *(0,) * (18 - len(values))))


# ----------------------------------------------------------------------------------- overrides


def test_rc_override_replaces_transmitter_channels() -> None:
    copter, client = ready_copter()
    assert channels(client) == (*RESTING, *(0,) * 10)
    override(client, 1600, 0, SAME, 1400)
    assert channels(client)[:4] == (1600, 1500, 1000, 1400)
    override(client, SAME, 1300)
    assert channels(client)[:4] == (1600, 1300, 1000, 1500)
    assert copter.rc[1] == 1300
    copter.rc[2] = 1700
    assert channels(client)[2] == 1700


def test_upper_channels_are_released_by_special_value() -> None:
    _, client = ready_copter()
    override(client, *(0,) * 8, 1234, 1300, *(0,) * 7, 1700)
    assert channels(client)[8:] == (1234, 1300, *(0,) * 8), "17 and 18 cannot be overridden"
    override(client, *(0,) * 8, 0, RELEASE)
    assert channels(client)[8:] == (1234, *(0,) * 9)
    override(client, RELEASE)
    assert channels(client)[0] == RELEASE


def test_rc_override_expires() -> None:
    copter, client = ready_copter()
    override(client, 1600)
    client.run(2.8)
    assert channels(client)[0] == 1600
    client.run(0.5)
    assert channels(client)[0] == 1500
    copter.parameters["RC_OVERRIDE_TIME"] = -1
    override(client, 1700)
    client.run(60.0)
    assert channels(client)[0] == 1700
    copter.parameters["RC_OVERRIDE_TIME"] = 0
    assert channels(client)[0] == 1500


def test_rc_override_of_other_ground_station_is_ignored() -> None:
    copter, client = ready_copter()
    copter.parameters["MAV_GCS_SYSID"] = 42
    override(client, 1600)
    assert channels(client)[0] == 1500


def test_rc_channels_raw_is_sent_in_mavlink_1_only() -> None:
    received = {}
    for version in (1, 2):
        copter = SimulatedCopter(boot_time_s=0.0)
        channel = copter.open_channel(version=version)
        client = Client(copter)
        request = m.RequestDataStream(1, 1, MavDataStream.RC_CHANNELS, 10, 1)
        copter.receive(client._encoder.encode(request), 1.0, channel=channel)
        client.now = 1.0
        client.run(1.0)
        frames = Framer().receive(channel.take_outbox(), 2.0)
        received[version] = {frame.message_id for frame in frames}
    assert m.RcChannelsRaw.ID in received[1]
    assert received[2] == received[1] - {m.RcChannelsRaw.ID}


# -------------------------------------------------------------------------------- calibrations


def calibrate(client: Client, *params: float) -> tuple[int | None, list[str]]:
    """Return the result of a calibration and the texts until then."""
    client.clear()
    result = client.command(MavCmd.PREFLIGHT_CALIBRATION, *params)
    client.run(1.5)
    result = client.ack_since(0, MavCmd.PREFLIGHT_CALIBRATION) if result is None else result
    return result, client.texts


def test_calibration_is_acknowledged_at_its_end() -> None:
    _, client = ready_copter()
    begins = "Initialising ArduPilot"
    assert calibrate(client, 1) == (ACCEPTED, [begins])
    assert calibrate(client, 0, 0, 0, 0, 2) == (ACCEPTED, [begins, "Trim OK: roll=0.00 pitch=0.00 yaw=0.00"])
    assert calibrate(client, 0, 0, 0, 0, 1) == (ACCEPTED, [begins, "Place vehicle level and press any key."])
    assert calibrate(client, 0, 0, 1)[1] == [
        "Updating barometer calibration",
        "Barometer calibration complete",
    ]
    assert calibrate(client, 0, 0, 0, 0, 4) == (ACCEPTED, [begins])
    assert calibrate(client, 0, 0, 0, 0, 4) == (REJECTED, [])
    assert calibrate(client, 0, 1)[0] == MavResult.UNSUPPORTED
    assert calibrate(client, 0, 76)[0] == ACCEPTED


def test_calibration_while_armed_is_refused() -> None:
    _, client = ready_copter()
    assert client.command(MavCmd.COMPONENT_ARM_DISARM, 1) == ACCEPTED
    assert calibrate(client, 1) == (FAILED, ["Disarm to allow calibration"])
    client.clear()
    assert client.command(MavCmd.DO_START_MAG_CAL, 0, 1, 1) == FAILED
    client.run(0.1)
    assert client.texts == ["Disarm to allow compass calibration"]


@pytest.mark.parametrize("end", [(MavCmd.DO_CANCEL_MAG_CAL, 0, 0.1), (MavCmd.PREFLIGHT_REBOOT_SHUTDOWN, 1, 10.0)])
def test_running_compass_calibration_prevents_arming(end: tuple[int, int, float]) -> None:
    _, client = ready_copter()
    assert client.command(MavCmd.DO_START_MAG_CAL, 300) == FAILED
    assert client.command(MavCmd.DO_START_MAG_CAL, 0, 1, 1) == ACCEPTED
    assert client.command(MavCmd.COMPONENT_ARM_DISARM, 1) == FAILED
    client.run(0.1)
    assert client.texts == ["Arm: Compass calibration running"]
    command, param, seconds = end
    assert client.command(MavCmd.DO_CANCEL_MAG_CAL, -1) == FAILED
    assert client.command(command, param) == ACCEPTED
    client.run(seconds)
    assert client.command(MavCmd.COMPONENT_ARM_DISARM, 1) == ACCEPTED
