"""Camera, gimbal, winch, gripper, arm authorizer and sources, with aerokit's own client as peer."""

from __future__ import annotations

import asyncio
import math
from pathlib import Path

import pytest
from onboard_peers import autopilot_and_client, device_and_client, payload_and_station

from aerokit.errors import AerokitError, BusyError, CommandRejected, InvalidArgument, OperationRejected
from aerokit.mavlink import messages as m
from aerokit.mavlink.encoder import FrameEncoder
from aerokit.mavlink.enums import (
    CameraZoomType,
    GimbalManagerFlags,
    MavArmAuthDeniedReason,
    MavCmd,
    MavFrame,
    MavModeFlag,
    MavResult,
    MavState,
    MavType,
    MavWinchStatusFlag,
    WinchActions,
)
from aerokit.onboard import (
    AutopilotDriver,
    CameraDriver,
    GimbalDriver,
    GimbalTarget,
    Photo,
    Storage,
    WinchDriver,
    WinchReport,
)
from aerokit.position import Position
from aerokit.protocols.rtcm import crc24q
from aerokit.sim.components.camera import own_definition

pytestmark = pytest.mark.anyio


class Eye(CameraDriver):
    def __init__(self, **arguments: object) -> None:
        super().__init__(vendor="Acme", model="Eye", **arguments)  # type: ignore[arg-type]
        self.zoom_percent = 0.0
        self.calls: list[object] = []
        self.error: Exception | None = None
        self.delay_s = 0.1

    async def take_photo(self, index: int) -> Photo:
        await asyncio.sleep(self.delay_s)
        if self.error is not None:
            raise self.error
        place = Position(47.3977, 8.5456, altitude_amsl_m=500.0, altitude_relative_m=20.0)
        return Photo(f"mftp:///{index}.jpg", place, 0.0, -90.0, 45.0)

    async def start_video(self) -> None:
        self.calls.append("start")

    async def stop_video(self) -> None:
        self.calls.append("stop")

    async def zoom_to(self, percent: float) -> None:
        self.zoom_percent = percent

    async def track(self, place: tuple[float, ...]) -> None:
        self.calls.append(len(place))

    def storage(self) -> Storage:
        return Storage(1000.0, 10.0, 990.0, "SD")

    def on_setting(self, name: str, value: object) -> None:
        self.calls.append((name, value))


async def test_photo_has_position_and_attitude() -> None:
    async with device_and_client(100, MavType.CAMERA) as (component, vehicle):
        component.add_camera(Eye())
        capture = await vehicle.camera.take_photo()
        assert capture.place is not None
        assert (capture.success, capture.file_url, capture.place.altitude_relative_m) == (True, "mftp:///0.jpg", 20.0)
        assert capture.pitch_deg == pytest.approx(-90, abs=0.1)
        assert capture.roll_deg is not None


async def test_failed_photo_is_reported_as_failed() -> None:
    eye = Eye()
    eye.error = RuntimeError("the lens cap is on")
    async with device_and_client(100, MavType.CAMERA) as (component, vehicle):
        component.add_camera(eye)
        with pytest.raises(AerokitError), vehicle.subscribe(m.Statustext, capacity=10) as texts:
            await vehicle.camera.take_photo()
        assert texts.get_nowait().text == "take_photo: the lens cap is on"  # type: ignore[union-attr]


@pytest.mark.parametrize("delay_s", [0.1, 1.3])
async def test_series_waits_for_slow_camera(delay_s: float) -> None:
    eye = Eye()
    eye.delay_s = delay_s
    async with device_and_client(100, MavType.CAMERA) as (component, vehicle):
        component.add_camera(eye)
        await vehicle.camera.wait_found()
        async with vehicle.camera.photo_interval(0.5, count=4) as captures:
            indices = [(await anext(aiter(captures))).index for _ in range(4)]
    assert indices == [0, 1, 2, 3]


async def test_photo_that_no_message_can_carry_is_failed() -> None:
    class LongNames(Eye):
        async def take_photo(self, index: int) -> Photo:
            return Photo("x" * 400)

    async with payload_and_station() as (component, station):
        component.add_camera(LongNames())
        image = await station.ask(station.command_long(MavCmd.IMAGE_START_CAPTURE, 0, 0, 1, 1), m.CameraImageCaptured)
        assert component.connection.is_open
    assert image.capture_result == 0


async def test_error_of_storage_is_reported_and_connection_stays_open() -> None:
    class Broken(Eye):
        is_broken = False

        def storage(self) -> Storage:
            if self.is_broken:
                raise OSError("no card")
            return super().storage()

    eye = Broken()
    async with payload_and_station() as (component, station):
        component.add_camera(eye)
        await station.command(MavCmd.IMAGE_START_CAPTURE, 0, 0, 1, 1)
        eye.is_broken = True
        with station.collecting(m.Statustext) as texts:
            await asyncio.sleep(1.0)
            ack = await station.command(MavCmd.REQUEST_MESSAGE, m.CameraCaptureStatus.ID)
        assert component.connection.is_open
    assert ack.result == MavResult.FAILED
    assert "no card" in texts[0].text


async def test_stream_that_fails_is_reported_once(caplog: pytest.LogCaptureFixture) -> None:
    class Broken(Eye):
        is_broken = True

        def storage(self) -> Storage:
            if self.is_broken:
                raise OSError("no card")
            return super().storage()

    eye = Broken()
    request = MavCmd.SET_MESSAGE_INTERVAL, m.CameraCaptureStatus.ID, 100_000
    async with payload_and_station() as (component, station):
        component.add_camera(eye)
        refused = await station.command(*request)
        eye.is_broken = False
        with station.collecting(m.CameraCaptureStatus) as received:
            await asyncio.sleep(1.0)
            assert received == []
            accepted = await station.command(*request)
            caplog.clear()
            eye.is_broken = True
            await asyncio.sleep(1.0)
            assert len([record for record in caplog.records if record.exc_info]) == 1
            eye.is_broken = False
            await asyncio.sleep(1.0)
    assert (refused.result, accepted.result) == (MavResult.FAILED, MavResult.ACCEPTED)
    assert len(received) >= 10


async def test_digicam_control_during_photo_is_rejected() -> None:
    async with payload_and_station() as (component, station):
        component.add_camera(Eye())
        await station.command(MavCmd.IMAGE_START_CAPTURE, 0, 0, 1, 1)
        ack = await station.command(MavCmd.DO_DIGICAM_CONTROL, 0, 0, 0, 0, 1)
        await asyncio.sleep(1.0)
        next_ack = await station.command(MavCmd.IMAGE_START_CAPTURE, 0, 0, 1, 2)
    assert (ack.result, next_ack.result) == (MavResult.TEMPORARILY_REJECTED, MavResult.ACCEPTED)


async def test_series_after_stopped_slow_one_keeps_its_interval() -> None:
    eye = Eye()
    eye.delay_s = 1.3
    async with payload_and_station() as (component, station):
        component.add_camera(eye)
        await station.command(MavCmd.IMAGE_START_CAPTURE, 0, 0.5, 0)
        await asyncio.sleep(1.0)
        await station.command(MavCmd.IMAGE_STOP_CAPTURE)
        await asyncio.sleep(2.0)
        eye.delay_s = 0.1
        with station.collecting(m.CameraImageCaptured) as images:
            await station.command(MavCmd.IMAGE_START_CAPTURE, 0, 10.0, 0)
            await asyncio.sleep(5.0)
    assert len(images) == 1


async def test_photo_with_number_of_another_station_is_taken() -> None:
    async with payload_and_station() as (component, station):
        component.add_camera(Eye())
        command = station.command_long(MavCmd.IMAGE_START_CAPTURE, 0, 0, 1, 1)
        with station.collecting(m.CameraImageCaptured) as images:
            station.connection.send(command)
            await asyncio.sleep(1.0)
            station.connection.send_as(FrameEncoder(200, 190), command)
            await asyncio.sleep(1.0)
    assert len(images) == 2


async def test_video_that_is_stopped_while_it_starts_ends() -> None:
    class SlowEye(Eye):
        async def start_video(self) -> None:
            await is_stopped.wait()
            self.calls.append("start")

    is_stopped = asyncio.Event()
    eye = SlowEye()
    async with payload_and_station() as (component, station):
        component.add_camera(eye)
        station.connection.send(station.command_long(MavCmd.VIDEO_START_CAPTURE))
        await station.command(MavCmd.VIDEO_STOP_CAPTURE)
        with station.collecting(m.CommandAck) as acks:
            is_stopped.set()
            await asyncio.sleep(1.0)
    assert eye.calls == ["start", "stop"]
    assert acks[-1].result == MavResult.ACCEPTED


async def test_video_whose_start_was_cancelled_is_stopped() -> None:
    class SlowEye(Eye):
        async def start_video(self) -> None:
            self.calls.append("start")
            await asyncio.sleep(60.0)

    eye = SlowEye()
    async with payload_and_station() as (component, station):
        component.add_camera(eye)
        station.connection.send(station.command_long(MavCmd.VIDEO_START_CAPTURE))
        await asyncio.sleep(0.05)
        cancel = m.CommandCancel(*station.target, MavCmd.VIDEO_START_CAPTURE)
        cancelled = await station.ask(cancel, m.CommandAck)
        stopped = await station.command(MavCmd.VIDEO_STOP_CAPTURE)
        await station.command(MavCmd.VIDEO_STOP_CAPTURE)
    assert (cancelled.result, stopped.result) == (MavResult.CANCELLED, MavResult.ACCEPTED)
    assert eye.calls == ["start", "stop"]


async def test_video_zoom_tracking_and_storage_call_the_program() -> None:
    eye = Eye()
    async with device_and_client(100, MavType.CAMERA) as (component, vehicle):
        component.add_camera(eye)
        await vehicle.camera.start_video()
        await vehicle.camera.stop_video()
        await vehicle.camera.zoom_to(30.0)
        await vehicle.camera.track_point(0.5, 0.5, radius=0.1)
        (storage,) = await vehicle.camera.load_storage()
    assert eye.calls == ["start", "stop", 3]
    assert eye.zoom_percent == 30.0
    assert (storage.total_mib, storage.available_mib) == (1000.0, 990.0)


@pytest.mark.parametrize("steps", [math.nan, math.inf])
async def test_zoom_step_without_number_is_not_executed(steps: float) -> None:
    eye = Eye()
    async with payload_and_station(component_id=100, type=MavType.CAMERA) as (component, station):
        component.add_camera(eye)
        ack = await station.command(MavCmd.SET_CAMERA_ZOOM, CameraZoomType.STEP, steps)
    assert (ack.result, eye.zoom_percent) == (MavResult.DENIED, 0.0)


async def test_ready_made_part_does_not_replace_handler_of_program() -> None:
    async with payload_and_station() as (component, _):
        for command in (MavCmd.DO_GIMBAL_MANAGER_PITCHYAW, MavCmd.IMAGE_START_CAPTURE):
            component.command(command)(lambda request: None)
        with pytest.raises(InvalidArgument, match="PITCHYAW already has a handler"):
            component.add_gimbal(Head())
        with pytest.raises(InvalidArgument, match="IMAGE_START_CAPTURE already has a handler"):
            component.add_camera(Eye())


async def test_call_without_method_is_not_supported() -> None:
    async with device_and_client(100, MavType.CAMERA) as (component, vehicle):
        component.add_camera(Eye())
        await vehicle.camera.wait_found()
        with pytest.raises(AerokitError):
            await vehicle.camera.focus_to(50.0)
        with pytest.raises(CommandRejected) as raised:
            await vehicle.component(100).command(MavCmd.STORAGE_FORMAT, 1, 1)
    assert raised.value.result == MavResult.UNSUPPORTED


async def test_settings_of_definition_file_are_served() -> None:
    eye = Eye(definition=own_definition())
    async with device_and_client(100, MavType.CAMERA) as (component, vehicle):
        component.add_camera(eye)
        settings = vehicle.component(100).settings
        await settings.download()
        await settings.set("CAM_MODE", 1)
        with pytest.raises(InvalidArgument, match="cannot have both"):
            component.parameters.add("SPEED", 1.0)
    assert eye.calls == [("CAM_MODE", 1)]


async def test_setting_whose_function_raises_is_failed_and_unchanged() -> None:
    class Stuck(Eye):
        def on_setting(self, name: str, value: object) -> None:
            raise RuntimeError("the lens is stuck")

    async with device_and_client(100, MavType.CAMERA) as (component, vehicle):
        component.add_camera(Stuck(definition=own_definition()))
        settings = vehicle.component(100).settings
        await settings.download()
        for _ in range(2):
            with pytest.raises(AerokitError):
                await settings.set("CAM_MODE", 1)
        assert await settings.get("CAM_MODE") == 0


class Head(GimbalDriver):
    def __init__(self) -> None:
        super().__init__(pitch_deg=(-90.0, 20.0), yaw_deg=(-160.0, 160.0))
        self.targets: list[GimbalTarget] = []

    def point(self, target: GimbalTarget) -> None:
        self.targets.append(target)

    def attitude(self) -> tuple[float, float, float]:
        latest = self.targets[-1] if self.targets else None
        return (0.0, 0.0, 0.0) if latest is None or latest.angles is None else latest.angles


async def test_gimbal_points_within_its_limits() -> None:
    head = Head()
    async with device_and_client(154, MavType.GIMBAL) as (component, vehicle):
        component.add_gimbal(head)
        await vehicle.gimbals.discover()
        async with vehicle.gimbal.control():
            await vehicle.gimbal.point(pitch_deg=-45.0, yaw_deg=30.0)
        information = await vehicle.gimbal.information()
    angles = head.targets[0].angles
    assert angles is not None
    assert [round(angle, 3) for angle in angles] == [0, -45, 30]
    assert information.pitch_deg is not None
    assert [round(angle) for angle in information.pitch_deg] == [-90, 20]


async def test_gimbal_denies_program_that_is_not_in_control() -> None:
    head = Head()
    async with payload_and_station(component_id=154, type=MavType.GIMBAL) as (component, station):
        component.add_gimbal(head)
        ack = await station.command(MavCmd.DO_GIMBAL_MANAGER_PITCHYAW, -30, 0, math.nan, math.nan, 0, 0, 154)
        place = await station.command(MavCmd.DO_SET_ROI_LOCATION)
    assert (ack.result, place.result) == (MavResult.DENIED, MavResult.UNSUPPORTED)
    assert head.targets == []


class LookingHead(Head):
    def __init__(self) -> None:
        super().__init__()
        self.places: list[Position | None] = []

    def look_at(self, position: Position | None) -> None:
        self.places.append(position)


async def test_gimbal_that_was_pointed_follows_no_longer() -> None:
    head = LookingHead()
    position = m.GlobalPositionInt(0, 473977000, 85456000, 500_000, 0, 0, 0, 0, 0)
    async with payload_and_station(component_id=154, type=MavType.GIMBAL) as (component, station):
        component.add_gimbal(head)
        await station.command(MavCmd.DO_GIMBAL_MANAGER_CONFIGURE, 255, 190, -1, -1, 0, 0, 154)
        await station.command(MavCmd.DO_SET_ROI_SYSID, 255)
        station.connection.send(position)
        await station.command(MavCmd.DO_GIMBAL_MANAGER_PITCHYAW, -30, 0, math.nan, math.nan, 0, 0, 154)
        station.connection.send(position)
        await asyncio.sleep(0.1)
    assert (len(head.places), len(head.targets)) == (1, 1)


@pytest.mark.parametrize(
    ("latitude", "frame"),
    [(math.nan, None), (500.0, None), (47, MavFrame.GLOBAL_RELATIVE_ALT_INT), (2**31 - 1, MavFrame.GLOBAL_INT)],
)
async def test_gimbal_denies_place_that_it_does_not_know(latitude: float, frame: int | None) -> None:
    head = LookingHead()
    place = MavCmd.DO_SET_ROI_LOCATION
    async with payload_and_station(component_id=154, type=MavType.GIMBAL) as (component, station):
        component.add_gimbal(head)
        await station.command(MavCmd.DO_GIMBAL_MANAGER_CONFIGURE, 255, 190, -1, -1, 0, 0, 154)
        command: m.CommandLong | m.CommandInt = station.command_long(place, 0, 0, 0, 0, latitude, 8.0, 30.0)
        if frame is not None:
            command = m.CommandInt(*station.target, frame, place, 0, 0, 0, 0, 0, 0, int(latitude), 80000000, 30.0)
        ack = await station.ask(command, m.CommandAck)
    assert ack.result == MavResult.DENIED
    assert head.places == []


@pytest.mark.parametrize("system_id", [0, math.nan, 256])
async def test_gimbal_denies_to_follow_impossible_system(system_id: float) -> None:
    async with payload_and_station(component_id=154, type=MavType.GIMBAL) as (component, station):
        component.add_gimbal(LookingHead())
        await station.command(MavCmd.DO_GIMBAL_MANAGER_CONFIGURE, 255, 190, -1, -1, 0, 0, 154)
        assert (await station.command(MavCmd.DO_SET_ROI_SYSID, system_id)).result == MavResult.DENIED


async def test_gimbal_denies_infinite_angles() -> None:
    head = Head()
    async with payload_and_station(component_id=154, type=MavType.GIMBAL) as (component, station):
        component.add_gimbal(head)
        await station.command(MavCmd.DO_GIMBAL_MANAGER_CONFIGURE, 255, 190, -1, -1, 0, 0, 154)
        ack = await station.command(
            MavCmd.DO_GIMBAL_MANAGER_PITCHYAW, 0, math.inf, math.nan, math.nan, GimbalManagerFlags.YAW_LOCK, 0, 154
        )
    assert ack.result == MavResult.DENIED
    assert head.targets == []


@pytest.mark.parametrize("is_pointed", [False, True])
async def test_turning_gimbal_stops_at_end_of_block(is_pointed: bool) -> None:
    head = Head()
    async with payload_and_station(component_id=154, type=MavType.GIMBAL) as (component, station):
        component.add_gimbal(head)
        await station.command(MavCmd.DO_GIMBAL_MANAGER_CONFIGURE, 255, 190, -1, -1, 0, 0, 154)
        await station.command(MavCmd.DO_GIMBAL_MANAGER_PITCHYAW, math.nan, math.nan, 5, 9, 0, 0, 154)
        if is_pointed:
            await station.command(MavCmd.DO_GIMBAL_MANAGER_PITCHYAW, -30, 0, math.nan, math.nan, 0, 0, 154)
    assert [target.rates is not None and any(target.rates) for target in head.targets] == [True, False]
    assert (head.targets[-1].rates is None) == is_pointed


async def test_turning_gimbal_whose_pointing_fails_stops_at_block_end() -> None:
    class Jammed(Head):
        def point(self, target: GimbalTarget) -> None:
            if target.angles is not None:
                raise RuntimeError("jammed")
            super().point(target)

    head = Jammed()
    async with payload_and_station(component_id=154, type=MavType.GIMBAL) as (component, station):
        component.add_gimbal(head)
        await station.command(MavCmd.DO_GIMBAL_MANAGER_CONFIGURE, 255, 190, -1, -1, 0, 0, 154)
        await station.command(MavCmd.DO_GIMBAL_MANAGER_PITCHYAW, math.nan, math.nan, 5, 9, 0, 0, 154)
        await station.command(MavCmd.DO_GIMBAL_MANAGER_PITCHYAW, -30, 0, math.nan, math.nan, 0, 0, 154)
    assert [target.rates for target in head.targets][1:] == [(0.0, 0.0, 0.0)]


async def test_gimbal_ignores_commands_while_component_closes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing would stop a gimbal that begins to turn while the parameters are written."""
    head = Head()
    async with payload_and_station(component_id=154, type=MavType.GIMBAL) as (component, station):
        component.add_gimbal(head)
        await station.command(MavCmd.DO_GIMBAL_MANAGER_CONFIGURE, 255, 190, -1, -1, 0, 0, 154)

        async def write_slowly(_: object) -> None:
            turn = station.command_long(MavCmd.DO_GIMBAL_MANAGER_PITCHYAW, math.nan, math.nan, 5, 9, 0, 0, 154)
            if station.connection.is_open:
                station.connection.send(turn)
            await asyncio.sleep(1)

        monkeypatch.setattr(type(component.parameters), "aclose", write_slowly)
        await component._aclose()
    assert head.targets == []


async def test_error_of_gimbal_is_result_of_command() -> None:
    class Jammed(Head):
        def point(self, target: GimbalTarget) -> None:
            raise RuntimeError("jammed")

    async with payload_and_station(component_id=154, type=MavType.GIMBAL) as (component, station):
        component.add_gimbal(Jammed())
        await station.command(MavCmd.DO_GIMBAL_MANAGER_CONFIGURE, 255, 190, -1, -1, 0, 0, 154)
        ack = await station.command(MavCmd.DO_GIMBAL_MANAGER_PITCHYAW, -30, 0, math.nan, math.nan, 0, 0, 154)
    assert ack.result == MavResult.FAILED


class Spool(WinchDriver):
    def __init__(self) -> None:
        self.length_m, self.flags = 0.0, int(MavWinchStatusFlag.HEALTHY)

    async def pay_out(self, length_m: float, rate_m_s: float) -> None:
        await asyncio.sleep(abs(length_m) / rate_m_s)
        self.length_m += length_m

    async def retract(self) -> None:
        self.length_m, self.flags = 0.0, self.flags | MavWinchStatusFlag.FULLY_RETRACTED

    def report(self) -> WinchReport:
        return WinchReport(length_m=self.length_m, speed_m_s=0.0, flags=self.flags)


class Reel(Spool):
    """Records its rates; it stops by a rate of zero."""

    def __init__(self) -> None:
        super().__init__()
        self.rates: list[float] = []

    async def set_rate(self, rate_m_s: float) -> None:
        self.rates.append(rate_m_s)


class HoldingReel(Reel):
    async def hold(self) -> None:
        self.rates.append(0.0)


@pytest.mark.parametrize(("reel", "rates"), [(Reel, [1.0]), (HoldingReel, [1.0]), (Reel, [1.0, 0.0])])
async def test_running_winch_stops_at_end_of_block(reel: type[Reel], rates: list[float]) -> None:
    spool = reel()
    async with payload_and_station(component_id=169, type=MavType.WINCH) as (component, station):
        component.add_winch(spool)
        for rate in rates:
            await station.command(MavCmd.DO_WINCH, 1, WinchActions.RATE_CONTROL, 0, rate)
    assert spool.rates == [1.0, 0.0]


async def test_block_ends_although_winch_never_stops() -> None:
    class Jammed(Reel):
        async def hold(self) -> None:
            await asyncio.sleep(math.inf)

    async with payload_and_station(component_id=169, type=MavType.WINCH) as (component, station):
        component.add_winch(Jammed())
        await station.command(MavCmd.DO_WINCH, 1, WinchActions.RATE_CONTROL, 0, 1.0)
        with station.collecting(m.Statustext) as texts:
            await component._aclose()
            await asyncio.sleep(0.1)
    assert any("stopping the winch" in text.text for text in texts)


async def test_parameters_are_saved_although_stopping_winch_raises_cancelled_error(tmp_path: Path) -> None:
    class Motorized(Reel):
        async def hold(self) -> None:
            motor = asyncio.ensure_future(asyncio.sleep(math.inf))
            motor.cancel()
            await motor

    path = tmp_path / "parameters.json"
    async with payload_and_station(component_id=169, type=MavType.WINCH, parameters_file=path) as (component, station):
        component.add_winch(Motorized())
        component.parameters.add("SPEED", 1.0)
        await station.command(MavCmd.DO_WINCH, 1, WinchActions.RATE_CONTROL, 0, 1.0)
        component.parameters.set("SPEED", 2.0)
        await component._aclose()
    assert "2.0" in path.read_text()


async def test_winch_pays_out_and_retracts() -> None:
    spool = Spool()
    async with device_and_client(169, MavType.WINCH) as (component, vehicle):
        component.add_winch(spool)
        winch = vehicle.winch(component_id=169)
        await winch.pay_out(4.0, rate_m_s=1.0)
        assert spool.length_m == 4.0
        await winch.retract()
        with pytest.raises(CommandRejected):
            await winch.relax()
    assert spool.length_m == 0.0


async def test_hold_stops_winch_that_pays_out() -> None:
    class Holding(Spool):
        is_held = False

        async def hold(self) -> None:
            self.is_held = True

    spool = Holding()
    pay_out, hold = WinchActions.RELATIVE_LENGTH_CONTROL, WinchActions.HOLD
    async with payload_and_station(component_id=169, type=MavType.WINCH) as (component, station):
        component.add_winch(spool)
        station.connection.send(station.command_long(MavCmd.DO_WINCH, 1, pay_out, 50, 1))
        await asyncio.sleep(0.05)
        with station.collecting(m.CommandAck) as acks:
            station.connection.send(station.command_long(MavCmd.DO_WINCH, 1, pay_out, 20, 1))
            station.connection.send_as(FrameEncoder(200, 190), station.command_long(MavCmd.DO_WINCH, 1, hold))
            await asyncio.sleep(60.0)
    assert [ack.result for ack in acks] == [MavResult.TEMPORARILY_REJECTED, MavResult.CANCELLED, MavResult.ACCEPTED]
    assert (spool.is_held, spool.length_m) == (True, 0.0)


async def test_repeated_hold_stops_winch_that_pays_out_again() -> None:
    """The first transmission of the second order to hold was lost."""

    class Holding(Spool):
        holds = 0

        async def hold(self) -> None:
            self.holds += 1

    spool = Holding()
    pay_out, hold = WinchActions.RELATIVE_LENGTH_CONTROL, WinchActions.HOLD
    async with payload_and_station(component_id=169, type=MavType.WINCH) as (component, station):
        component.add_winch(spool)
        await station.command(MavCmd.DO_WINCH, 1, hold)
        station.connection.send(station.command_long(MavCmd.DO_WINCH, 1, pay_out, 50, 1))
        await asyncio.sleep(0.05)
        ack = await station.command(MavCmd.DO_WINCH, 1, hold, confirmation=1)
        await asyncio.sleep(60.0)
    assert (ack.result, spool.holds, spool.length_m) == (MavResult.ACCEPTED, 2, 0.0)


class Model(AutopilotDriver):
    def __init__(self) -> None:
        self.calls: list[object] = []

    async def arm(self, force: bool) -> None:
        if not force:
            raise BusyError("the batteries are cold")
        self.calls.append("arm")

    async def disarm(self, force: bool) -> None:
        self.calls.append("disarm")

    async def set_mode(self, custom_mode: int) -> None:
        self.calls.append(custom_mode)

    async def take_off(self, altitude_m: float | None) -> None:
        self.calls.append(altitude_m)


async def test_autopilot_executes_commands_and_reports_them_in_heartbeat() -> None:
    model = Model()
    async with autopilot_and_client() as (node, vehicle):
        node.add_autopilot(model)
        with pytest.raises(OperationRejected, match="cold"):
            await vehicle.arm()
        await vehicle.arm(force=True)
        await vehicle.command(MavCmd.DO_SET_MODE, 1, 7)
        await vehicle.command(MavCmd.NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, 12.5)
        heartbeat = await vehicle.message(m.Heartbeat).wait_until(lambda beat: beat.custom_mode == 7, timeout=5)
        with pytest.raises(CommandRejected) as raised:
            await vehicle.command(MavCmd.NAV_LAND)
        await vehicle.disarm()
    assert model.calls == ["arm", 7, 12.5, "disarm"]
    assert heartbeat.base_mode & MavModeFlag.SAFETY_ARMED
    assert raised.value.result == MavResult.UNSUPPORTED


async def test_disarm_ends_arming_that_takes_long() -> None:
    class Slow(Model):
        async def arm(self, force: bool) -> None:
            await asyncio.sleep(5.0)
            self.calls.append("arm")

    model = Slow()
    async with payload_and_station(component_id=1, type=MavType.QUADROTOR) as (component, station):
        component.add_autopilot(model)
        station.connection.send(station.command_long(MavCmd.COMPONENT_ARM_DISARM, 1))
        await asyncio.sleep(0.05)
        with station.collecting(m.CommandAck) as acks, station.connection.subscribe(m.Heartbeat) as heartbeats:
            station.connection.send(station.command_long(MavCmd.COMPONENT_ARM_DISARM, 0))
            await asyncio.sleep(10.0)
            heartbeat = heartbeats.get_nowait()
    assert [ack.result for ack in acks] == [MavResult.ACCEPTED]
    assert model.calls == ["disarm"]
    assert heartbeat is not None
    assert not heartbeat.base_mode & MavModeFlag.SAFETY_ARMED


@pytest.mark.parametrize(
    ("frame", "altitude_m", "calls"),
    [
        (MavFrame.GLOBAL_RELATIVE_ALT, 12.5, [12.5]),
        (MavFrame.GLOBAL, math.nan, [None]),
        (MavFrame.GLOBAL, 488.0, []),
        (MavFrame.GLOBAL_RELATIVE_ALT, math.inf, []),
    ],
)
async def test_take_off_is_executed_only_with_altitude_above_home(
    frame: int, altitude_m: float, calls: list[float | None]
) -> None:
    model = Model()
    async with payload_and_station(component_id=1) as (node, station):
        node.add_autopilot(model)
        command = m.CommandInt(*station.target, frame, MavCmd.NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, 0, 0, altitude_m)
        ack = await station.ask(command, m.CommandAck)
    assert model.calls == calls
    assert ack.result == (MavResult.ACCEPTED if calls else MavResult.DENIED)


async def test_base_mode_without_custom_mode_is_denied() -> None:
    model = Model()
    async with payload_and_station(component_id=1) as (node, station):
        node.add_autopilot(model)
        ack = await station.command(MavCmd.DO_SET_MODE, MavModeFlag.GUIDED_ENABLED, 0)
    assert (ack.result, model.calls) == (MavResult.DENIED, [])


async def test_set_state_keeps_armed_and_mode() -> None:
    async with payload_and_station(component_id=1) as (node, station):
        node.add_autopilot(Model())
        await station.command(MavCmd.COMPONENT_ARM_DISARM, 1, 21196)
        await station.command(MavCmd.DO_SET_MODE, MavModeFlag.CUSTOM_MODE_ENABLED, 7)
        with station.connection.subscribe(m.Heartbeat) as beats:
            node.set_state(MavState.CRITICAL)
            beat = await beats.get(5.0)
    assert (beat.system_status, beat.custom_mode) == (MavState.CRITICAL, 7)
    assert beat.base_mode & MavModeFlag.SAFETY_ARMED


@pytest.mark.parametrize(("value", "is_forced"), [(0, False), (2989, False), (21196, True)])
async def test_only_standard_value_forces_disarming(value: int, is_forced: bool) -> None:
    """2989 is ArduPilot's value for arming: a disarm with it must not stop the motors in flight."""
    calls: list[bool] = []

    class Flying(AutopilotDriver):
        async def disarm(self, force: bool) -> None:
            calls.append(force)

    async with autopilot_and_client() as (node, vehicle):
        node.add_autopilot(Flying())
        await vehicle.command(MavCmd.COMPONENT_ARM_DISARM, 0, value)
    assert calls == [is_forced]


async def test_gripper_grabs_and_releases() -> None:
    moves: list[str] = []

    async def grab() -> None:
        moves.append("grab")

    async def release() -> None:
        moves.append("release")

    async with payload_and_station() as (component, station):
        component.add_gripper(grab, release)
        results = [(await station.command(MavCmd.DO_GRIPPER, 1, action)).result for action in (1, 0, 7)]
    assert moves == ["grab", "release"]
    assert results == [MavResult.ACCEPTED, MavResult.ACCEPTED, MavResult.DENIED]


@pytest.mark.parametrize(("instance", "moves"), [(0, 1), (1, 1), (math.nan, 1), (191, 1), (2, 0)])
async def test_gripper_and_winch_ignore_commands_for_another_instance(instance: float, moves: int) -> None:
    """A command to all components also arrives at the components with the other grippers."""
    spool, released = Spool(), []

    async def release() -> None:
        released.append("release")

    async with payload_and_station() as (component, station):
        component.add_gripper(release, release)
        component.add_winch(spool)
        for command, *params in ((MavCmd.DO_GRIPPER, 0), (MavCmd.DO_WINCH, WinchActions.RELATIVE_LENGTH_CONTROL, 4, 1)):
            numbers = (*params, *(0.0,) * 6)[:6]
            await station.ask(m.CommandLong(1, 0, command, 0, instance, *numbers), m.CommandAck)
            await asyncio.sleep(10.0)
    assert len(released) == moves
    assert spool.length_m == 4.0 * moves


@pytest.mark.parametrize(
    ("system_id", "expected"),
    [
        (1, (MavResult.ACCEPTED, 30, 30)),
        (2, (MavResult.DENIED, 0, MavArmAuthDeniedReason.NONE)),
        (0, (MavResult.DENIED, 0, MavArmAuthDeniedReason.NONE)),  # the sender itself, system 255
    ],
)
async def test_arm_authorizer_allows_or_denies(system_id: int, expected: tuple[int, int, int]) -> None:
    async def authorize(system: int) -> float:
        if system != 1:
            raise ValueError("no flight plan")
        return 30.0

    async with payload_and_station() as (component, station):
        component.add_arm_authorizer(authorize)
        ack = await station.command(MavCmd.ARM_AUTHORIZATION_REQUEST, system_id)
    assert (ack.result, ack.progress, ack.result_param2) == expected


async def test_sources_send_their_messages() -> None:
    async with payload_and_station() as (component, station):
        with station.collecting(m.ObstacleDistance, m.AdsbVehicle, m.LandingTarget, m.GpsRtcmData) as received:
            sources = component.sources
            sources.send_obstacles([1.5, None, math.inf], increment_deg=5.0, min_m=0.2, max_m=10.0)
            sources.send_traffic(0x4B1234, Position(47.4, 8.5, altitude_amsl_m=900.0), callsign="HBABC")
            sources.send_landing_target(2.0, -3.0, 4.5)
            message = bytes([0xD3, 0, 194]) + bytes(194)
            sources.send_corrections(message + crc24q(message).to_bytes(3, "big"))
            await asyncio.sleep(0.1)
    obstacles, traffic, target, *corrections = received
    assert obstacles.distances[:4] == (150, 0xFFFF, 1001, 0xFFFF)
    assert (traffic.ICAO_address, traffic.callsign, traffic.altitude) == (0x4B1234, "HBABC", 900_000)
    assert (target.distance, round(math.degrees(target.angle_y))) == (4.5, -3)
    assert [piece.len for piece in corrections] == [180, 20]


@pytest.mark.parametrize(
    "arguments",
    [{"distances_m": []}, {"distances_m": [-1.0]}, {"max_m": 700.0}, {"increment_deg": 0.0}],
)
async def test_invalid_obstacles_are_refused(arguments: dict[str, object]) -> None:
    valid = {"distances_m": [1.0], "increment_deg": 5.0, "min_m": 0.2, "max_m": 10.0}
    async with payload_and_station() as (component, _):
        with pytest.raises(InvalidArgument):
            component.sources.send_obstacles(**{**valid, **arguments})  # type: ignore[arg-type]


async def test_pictures_are_read_from_the_component(tmp_path: Path) -> None:
    (tmp_path / "0.jpg").write_bytes(b"picture")
    async with device_and_client(100, MavType.CAMERA) as (component, vehicle):
        component.serve_files(tmp_path)
        component.add_camera(Eye())
        capture = await vehicle.camera.take_photo()
        assert await vehicle.camera.read_picture(capture) == b"picture"
