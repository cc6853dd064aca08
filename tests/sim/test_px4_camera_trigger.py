"""Camera trigger of a simulated PX4: enabling, double reports, series."""

from __future__ import annotations

import pytest
from component_client import ComponentClient, settled

from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import MavCmd, MavResult
from aerokit.sim import SimulatedPx4

CONTROL, SWITCH = MavCmd.DO_DIGICAM_CONTROL, MavCmd.DO_TRIGGER_CONTROL
INTERVAL = MavCmd.DO_SET_CAM_TRIGG_INTERVAL
DONE = [MavResult.ACCEPTED]
SHOOT = (0, 0, 0, 0, 1)


def fitted(mode: float = 1.0) -> tuple[SimulatedPx4, ComponentClient]:
    px4 = SimulatedPx4(boot_time_s=0.0)
    px4.parameters["TRIG_MODE"] = mode
    return px4, settled(px4)


def test_commands_without_trigger_are_not_answered() -> None:
    _, client = fitted(0.0)
    for command in (CONTROL, SWITCH, INTERVAL):
        assert client.ask(1, command, 1, 0, 0, 0, 1) == []
    client.run(1.0)
    assert client.all(m.CameraTrigger) == []


def test_image_is_reported_twice() -> None:
    px4, client = fitted()
    assert client.ask(1, CONTROL, *SHOOT) == DONE
    assert client.ask(1, CONTROL, *SHOOT) == [MavResult.TEMPORARILY_REJECTED]
    client.run(0.1)
    assert client.ask(1, CONTROL) == DONE
    (trigger,) = client.all(m.CameraTrigger)
    (image,) = client.all(m.CameraImageCaptured)
    assert (trigger.seq, image.image_index, image.camera_id, image.capture_result) == (0, 0, 1, 1)
    assert image.lat == pytest.approx(px4.frame.origin.latitude_e7, abs=50)


def test_series_runs_until_stopped() -> None:
    px4, client = fitted()
    assert client.ask(1, INTERVAL, 500, -1) == DONE
    assert client.ask(1, SWITCH, 1, 1, 0) == DONE
    client.run(2.2)
    assert client.ask(1, SWITCH, -1, -1, 1) == DONE
    assert [message.seq for message in client.all(m.CameraTrigger)] == [0, 1, 2, 3, 4]
    client.run(2.0)
    assert px4.camera_trigger.sequence == 5
    assert client.ask(1, SWITCH, -1, -1, 0) == DONE
    client.run(0.2)
    assert px4.camera_trigger.sequence == 6
    assert client.ask(1, SWITCH, 0, -1, -1) == DONE
    client.run(2.0)
    assert px4.camera_trigger.sequence == 6
