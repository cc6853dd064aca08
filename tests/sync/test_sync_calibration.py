"""Calibrations and corrections without async."""

from __future__ import annotations

import gc
import time

from served_copter import served

import aerokit.sync
from aerokit.sim import SimulatedCopter


def test_calibration_steps_end_with_result() -> None:
    with served([SimulatedCopter(boot_time_s=0.0)]) as address, aerokit.sync.connect(address) as vehicle:
        steps = list(vehicle.calibrate.gyroscope())
        assert [step.result is not None for step in steps] == [False, True]


def test_break_cancels_on_vehicle() -> None:
    copter = SimulatedCopter(boot_time_s=0.0)
    with served([copter]) as address, aerokit.sync.connect(address) as vehicle:
        for _ in vehicle.calibrate.compass():
            assert copter.calibrations.is_compass_running
            break
        gc.collect()
        deadline = time.monotonic() + 20
        while copter.calibrations.is_compass_running and time.monotonic() < deadline:
            vehicle.mode.updates().__next__()  # the next HEARTBEAT
        assert not copter.calibrations.is_compass_running


def test_corrections_reach_vehicle() -> None:
    copter = SimulatedCopter(boot_time_s=0.0)
    message = bytes.fromhex("D300133ED7D30202980EDEEF34B4BD62AC0941986F33360B98")
    with served([copter]) as address, aerokit.sync.connect(address) as vehicle:
        vehicle.rtk.send(message)
        assert vehicle.rtk.corrections.value.message_number == 1005
        list(vehicle.calibrate.barometer())  # Commands arrive after the corrections.
        assert copter.corrections.messages == [message]
