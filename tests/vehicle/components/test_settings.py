"""Settings of components by PARAM_EXT, with and without a camera definition file."""

from __future__ import annotations

import lzma
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import anyio
import pytest

import aerokit
from aerokit import messages as m
from aerokit._internal.files import MAX_FILE_SIZE
from aerokit.errors import (
    FileError,
    FileFormatError,
    InvalidArgument,
    NotSupported,
    OperationTimeout,
    ParameterRejected,
    ParameterTimeout,
)
from aerokit.events import SettingChanged
from aerokit.mavlink.enums import CameraMode, MavCmd, MavParamExtType, ParamAck
from aerokit.mavlink.message import Message
from aerokit.parameters import Setting
from aerokit.sim import SimulatedCamera, SimulatedCopter, SimulatedGimbal, simulated_link
from aerokit.sim.components.camera import DEFINITION_PATH, own_definition
from aerokit.vehicle.components.settings import Settings

pytestmark = pytest.mark.anyio
LISTED = 12


class Bench:
    """A camera, the messages sent to it, and its settings."""

    def __init__(self, camera: SimulatedCamera, vehicle: aerokit.Vehicle) -> None:
        self.camera, self.vehicle = camera, vehicle
        self.component = vehicle.component(100)
        self.settings: Settings = self.component.settings
        self.sent: list[Message] = []
        for kind in (m.ParamExtSet, m.ParamExtRequestRead, m.ParamExtRequestList, m.FileTransferProtocol):
            camera.vehicle.observe(kind, lambda message, _: self.sent.append(message))

    def all(self, kind: type[Message]) -> list[Any]:
        return [message for message in self.sent if isinstance(message, kind)]

    @property
    def values(self) -> dict[str, Any]:
        return self.camera.parameters.values


@asynccontextmanager
async def on_board(*others: SimulatedCamera | SimulatedGimbal, **options: Any) -> AsyncIterator[Bench]:
    camera = SimulatedCamera(**options)
    copter = SimulatedCopter(boot_time_s=0.0, components=(camera, *others))
    async with simulated_link(copter) as link, aerokit.connect(link) as vehicle:
        await anyio.sleep(1.5)
        yield Bench(camera, vehicle)


# -------------------------------------------------------------------------- without a definition


async def test_download_begins_again_after_reboot_of_vehicle() -> None:
    async with on_board() as shelf, anyio.create_task_group() as tasks:

        async def reboot() -> None:
            await anyio.sleep(0.05)
            assert 0 < len(shelf.settings.table) < LISTED
            shelf.vehicle._session._on_reboot()

        tasks.start_soon(reboot)
        found = await shelf.settings.download()
        assert len(shelf.all(m.ParamExtRequestList)) == 2
        assert len(found) == LISTED


async def test_settings_download_with_numbers_and_texts() -> None:
    async with on_board() as shelf:
        found = await shelf.settings.download()
        assert len(found) == LISTED
        assert found["CAM_OFFSET"] == Setting("CAM_OFFSET", -5, MavParamExtType.INT16, 9)
        assert found["CAM_LENS"] == Setting("CAM_LENS", "aerokit 4.5 mm", MavParamExtType.CUSTOM, 11)
        assert found["CAM_STAMP"].value == 0
        assert found["CAM_EV"].value == 0.0
        assert shelf.settings.is_complete
        assert await shelf.settings.download() == shelf.settings.table == found
        assert len(shelf.all(m.ParamExtRequestList)) == 1
        await shelf.settings.download(refresh=True)
        assert len(shelf.all(m.ParamExtRequestList)) == 2


async def test_lost_settings_are_requested_again() -> None:
    async with on_board() as shelf:
        shelf.camera.faults.loss = shelf.camera.faults.loss_incoming = 0.4
        assert len(await shelf.settings.download(idle_timeout_s=60.0)) == LISTED


async def test_component_without_settings_times_out() -> None:
    async with on_board(SimulatedGimbal()) as shelf:
        with pytest.raises(ParameterTimeout, match=r"PARAM_EXT_REQUEST_LIST was not answered.*last heartbeat of"):
            await shelf.vehicle.component(154).settings.download(idle_timeout_s=3.0)
        with pytest.raises(OperationTimeout, match=r"not done within 1 s"):
            await shelf.vehicle.component(154).settings.download(timeout=1.0)


async def test_setting_is_read_and_set_without_list() -> None:
    async with on_board() as shelf:
        settings = shelf.settings
        assert settings.known("CAM_WBMODE") is None
        assert await settings.get("CAM_WBMODE") == 0
        assert (await settings.set("CAM_WBMODE", 4)).value == shelf.values["CAM_WBMODE"] == 4
        assert (await settings.set("CAM_OWNER", "Zoë & Söhne")).value == shelf.values["CAM_OWNER"] == "Zoë & Söhne"
        assert (await settings.set("CAM_EV", -1.5)).value == shelf.values["CAM_EV"] == -1.5
        assert len(shelf.all(m.ParamExtSet)) == 3
        assert settings.table["CAM_EV"].value == -1.5


async def test_invalid_names_and_values_are_refused() -> None:
    async with on_board() as shelf:
        settings = shelf.settings
        await settings.download()
        shelf.sent.clear()
        for name, value, complaint in (
            ("", 1, "parameter name"),
            ("A" * 17, 1, "17 characters"),
            ("CAM_WBMODE", 1.5, "a whole number"),
            ("CAM_WBMODE", -1, r"CAM_WBMODE = -1 must be in 0\.\.4294967295"),
            ("CAM_WBMODE", "Sunny", "a number"),
            ("CAM_OWNER", 7, "text or bytes"),
        ):
            with pytest.raises(InvalidArgument, match=complaint):
                await settings.set(name, value)
        assert shelf.sent == []


async def test_unknown_setting_is_rejected() -> None:
    async with on_board() as shelf:
        with pytest.raises(ParameterRejected, match="no setting CAM_NOPE: it answers requests for other names"):
            await shelf.settings.get("CAM_NOPE")
        with pytest.raises(ParameterRejected, match="no setting CAM_NOPE"):
            await shelf.settings.set("CAM_NOPE", 1)
        assert shelf.all(m.ParamExtSet) == []


async def test_camera_refusal_has_its_code() -> None:
    async with on_board() as shelf:
        await shelf.settings.download()
        with pytest.raises(ParameterRejected, match="CAM_LENS was refused") as caught:
            await shelf.settings.set("CAM_LENS", "other")
        assert (caught.value.name, caught.value.code) == ("CAM_LENS", ParamAck.FAILED)
        with pytest.raises(ParameterRejected, match="does not accept this value") as caught:
            await shelf.settings.set("CAM_WBMODE", 77)
        assert caught.value.code == ParamAck.VALUE_UNSUPPORTED
        assert shelf.settings.table["CAM_WBMODE"].value == 0


async def test_setting_in_progress_is_awaited() -> None:
    async with on_board() as shelf:
        shelf.camera.parameters.slow["CAM_WBMODE"] = 4.0
        begun = shelf.vehicle.connection.now()
        assert (await shelf.settings.set("CAM_WBMODE", 5)).value == 5
        assert shelf.vehicle.connection.now() - begun == pytest.approx(4.0, abs=0.3)
        assert len(shelf.all(m.ParamExtSet)) == 1


async def test_set_returns_the_value_taken() -> None:
    async with on_board() as shelf:
        shelf.camera.faults.parameter_limits["CAM_EV"] = (-1.0, 1.0)
        assert (await shelf.settings.set("CAM_EV", 2.5)).value == 1.0


@pytest.mark.parametrize("with_definition", [True, False])
async def test_lost_write_after_cancelled_one_is_repeated(
    monkeypatch: pytest.MonkeyPatch, with_definition: bool
) -> None:
    """The value of the cancelled write is not taken for the camera's answer to the second write."""
    async with on_board() as bench:
        if with_definition:
            await bench.settings.fetch_definition()
        await bench.settings.download()
        bench.camera.faults.lose(m.ParamExtAck, times=1000)
        bench.camera.faults.lose(m.ParamExtValue, times=1000)
        with anyio.move_on_after(1.0):
            await bench.settings.set("CAM_QUALITY", 50)
        bench.camera.faults.lost_messages.clear()
        send = bench.vehicle.connection._try_to_send

        def lose_first_write(message: Message) -> bool:
            if not isinstance(message, m.ParamExtSet):
                return send(message)
            monkeypatch.undo()
            return True

        monkeypatch.setattr(bench.vehicle.connection, "_try_to_send", lose_first_write)
        assert (await bench.settings.set("CAM_QUALITY", 70)).value == 70
        assert bench.values["CAM_QUALITY"] == 70


async def test_silent_camera_times_out() -> None:
    async with on_board() as shelf:
        await shelf.settings.download()
        shelf.camera.faults.silent = True
        with pytest.raises(ParameterTimeout, match="PARAM_EXT_SET of CAM_EV was not confirmed, sent 1 times"):
            await shelf.settings.set("CAM_EV", 1.0, idle_timeout_s=3.0)
        assert len(shelf.all(m.ParamExtSet)) == 1
        with pytest.raises(ParameterTimeout):
            await shelf.settings.get("CAM_EV", idle_timeout_s=1.0)


async def test_setting_changes_are_published() -> None:
    async with on_board() as shelf:
        settings = shelf.settings
        await settings.download()
        with shelf.vehicle.subscribe(SettingChanged, capacity=10) as changes:
            await settings.set("CAM_WBMODE", 4)
            event = await changes.get(timeout=1)
            assert (event.name, event.before, event.after, event.component_id) == ("CAM_WBMODE", 0, 4, 100)
            stranger = m.ParamExtSet(1, 100, "CAM_OWNER", b"me", MavParamExtType.CUSTOM)
            shelf.camera.parameters._on_set(stranger, shelf.camera.vehicle.channels[0])
            assert (await changes.get(timeout=1)).after == "me"
            await shelf.component.command(MavCmd.SET_CAMERA_MODE, 0, CameraMode.VIDEO)
            assert (await changes.get(timeout=1)).to_dict() | {"at": 0} == {
                "at": 0,
                "system_id": 1,
                "component_id": 100,
                "name": "CAM_MODE",
                "before": 0,
                "after": 1,
            }
            await settings.get("CAM_LENS")
            refused = m.ParamExtAck("CAM_WBMODE", b"\x09", MavParamExtType.UINT32, ParamAck.FAILED)
            shelf.camera.send(refused)
            await anyio.sleep(0.5)
            assert changes.get_nowait() is None
        assert settings.table["CAM_MODE"].value == 1
        assert settings.table["CAM_WBMODE"] == Setting("CAM_WBMODE", 4, MavParamExtType.UINT32, 5)


async def test_two_cameras_have_separate_settings() -> None:
    async with on_board(SimulatedCamera(101)) as shelf:
        other = shelf.vehicle.component(101).settings
        await shelf.settings.download()
        await other.download()
        await other.set("CAM_WBMODE", 5)
        assert shelf.settings.table["CAM_WBMODE"].value == shelf.values["CAM_WBMODE"] == 0


async def test_reboot_clears_settings() -> None:
    async with on_board() as shelf:
        await shelf.settings.download()
        await shelf.vehicle.reboot()
        assert not shelf.settings.table
        assert not shelf.settings.is_complete
        assert len(await shelf.settings.download(idle_timeout_s=20.0)) == LISTED


# ---------------------------------------------------------------------------- with a definition


async def test_definition_is_fetched_from_the_camera() -> None:
    async with on_board() as shelf:
        definition = await shelf.settings.fetch_definition()
        assert definition is shelf.settings.definition
        assert definition.settings.keys() == shelf.camera.definition.settings.keys()
        assert (await shelf.settings.read("CAM_STAMP")).value is False


async def test_definition_compressed_remote_and_localized() -> None:
    async with on_board(SimulatedCamera(101)) as shelf:
        shelf.camera.files.put("/info/my camera.xml.xz", lzma.compress(own_definition()))
        german = await shelf.settings.fetch_definition("mftp://info/my%20camera.xml.xz", locale="de")
        assert german.settings["CAM_WBMODE"].description == "Weißabgleich"
        assert (await shelf.settings.set("CAM_WBMODE", "Sonnig")).value == 4
        other = f"mavlinkftp://[;comp=100]{DEFINITION_PATH}"
        assert len((await shelf.vehicle.component(101).settings.fetch_definition(other)).settings) == LISTED


async def test_load_definition_from_file_or_object(tmp_path: Path) -> None:
    async with on_board(definition_uri="") as shelf:
        settings = shelf.settings
        await settings.download()
        assert settings.table["CAM_STAMP"].value == 0
        path = tmp_path / "camera.xml"
        path.write_bytes(own_definition())
        settings.load(path)
        assert settings.table["CAM_STAMP"].value is False
        path.write_bytes(b"<html/>")
        with pytest.raises(FileFormatError):
            settings.load(str(path))
        assert settings.definition is not None
        assert settings.load(shelf.camera.definition, locale="de") is settings.definition
        assert "Sonnig" in settings.options("CAM_WBMODE")
        with pytest.raises(NotSupported, match="component 100 names no definition file"):
            await settings.fetch_definition()


@pytest.mark.parametrize(
    ("uri", "error"),
    [
        ("mftp:///nowhere.xml", FileError),
        ("ftp://example.org/camera.xml", InvalidArgument),
        ("file:///etc/passwd", InvalidArgument),
        ("mftp://[;comp=0]/camera.xml", InvalidArgument),
        ("mftp://", InvalidArgument),
        ("mftp:///picture.jpg", FileFormatError),
    ],
)
async def test_invalid_definition_addresses(uri: str, error: type[Exception]) -> None:
    async with on_board(definition_uri=uri) as shelf:
        shelf.camera.files.put("/picture.jpg", b"\xff\xd8" * 100)
        with pytest.raises(error):
            await shelf.settings.fetch_definition()
        assert shelf.settings.definition is None


async def test_oversized_definition_is_not_fetched() -> None:
    async with on_board(definition_uri="mftp:///large") as shelf:
        shelf.camera.files.put("/large", bytes(MAX_FILE_SIZE + 1))
        with pytest.raises(FileFormatError, match="more than 16 MB"):
            await shelf.settings.fetch_definition()
        assert len(shelf.all(m.FileTransferProtocol)) < 10


async def test_options_are_set_by_name() -> None:
    async with on_board() as shelf:
        settings = shelf.settings
        await settings.fetch_definition()
        assert settings.options("CAM_WBMODE") == {"Auto": 0, "Sunny": 4, "Cloudy": 5}
        assert (await settings.set("CAM_WBMODE", "Cloudy")).value == 5
        assert (await settings.set("CAM_STAMP", True)).value is True
        assert settings.options("CAM_EV") == {}


async def test_disallowed_values_are_refused() -> None:
    async with on_board() as shelf:
        settings = shelf.settings
        await settings.fetch_definition()
        await settings.download()
        shelf.sent.clear()
        for name, value, complaint in (
            ("CAM_WBMODE", "Snowy", r"'Snowy' is not allowed: it must be one of 'Auto' \(0\), 'Sunny' \(4\)"),
            ("CAM_EV", 4, r"CAM_EV = 4 is not allowed: it must be -3\.\.3"),
            ("CAM_LENS", "other", "CAM_LENS = 'other' is not allowed: it can only be read"),
            ("CAM_ISO", 100, "CAM_ISO = 100 is not allowed now: the setting is excluded by CAM_EXPMODE = Auto"),
            ("CAM_QUALITY", 91, "10, 15, 20"),
        ):
            with pytest.raises(InvalidArgument, match=complaint):
                await settings.set(name, value)
        assert shelf.sent == []
        assert settings.excluded_by("CAM_ISO") == ("CAM_EXPMODE = Auto",)
        assert settings.excluded_by("CAM_EV") == ()


async def test_unknown_deciding_settings_are_read_first() -> None:
    async with on_board() as shelf:
        await shelf.settings.fetch_definition()
        with pytest.raises(InvalidArgument, match="excluded by CAM_EXPMODE = Auto"):
            await shelf.settings.set("CAM_ISO", "400")
        assert {request.param_id for request in shelf.all(m.ParamExtRequestRead)} == {
            "CAM_MODE",
            "CAM_EXPMODE",
            "CAM_ISO",
        }
        assert shelf.all(m.ParamExtSet) == []


GHOST = b"""<parameter name="CAM_GHOST" type="uint8"><options><option name="on" value="1"><exclusions>
    <exclude>CAM_WBMODE</exclude></exclusions></option></options></parameter></parameters>"""


@pytest.mark.parametrize("is_downloaded", [True, False])
async def test_absent_settings_are_requested_once(is_downloaded: bool) -> None:
    async with on_board() as shelf:
        shelf.camera.files.put("/ghost.xml", own_definition().replace(b"</parameters>", GHOST))
        await shelf.settings.fetch_definition("mftp:///ghost.xml")
        if is_downloaded:
            await shelf.settings.download()
        else:
            await shelf.settings.set("CAM_WBMODE", "Sunny")
            assert shelf.all(m.ParamExtRequestRead)
        shelf.sent.clear()
        await shelf.settings.set("CAM_WBMODE", "Cloudy")
        assert [type(message) for message in shelf.sent] == [m.ParamExtSet]


async def test_options_depend_on_other_settings() -> None:
    async with on_board() as shelf:
        settings = shelf.settings
        await settings.fetch_definition()
        await settings.download()
        await settings.set("CAM_EXPMODE", "Manual")
        await settings.set("CAM_ISO", 800)
        await shelf.component.command(MavCmd.SET_CAMERA_MODE, 0, CameraMode.VIDEO)
        assert list(settings.options("CAM_ISO")) == ["100", "200", "400"]
        with pytest.raises(
            InvalidArgument, match=r"CAM_ISO = 800 is not allowed while CAM_MODE = Video: it must be one of '100'"
        ):
            await settings.set("CAM_ISO", 800)
        await settings.set("CAM_MODE", "Photo")
        assert shelf.camera.mode == CameraMode.IMAGE
        assert (await settings.set("CAM_ISO", 800)).value == 800


async def test_dependent_settings_are_read_again() -> None:
    async with on_board() as shelf:
        settings = shelf.settings
        await settings.fetch_definition()
        await settings.download()
        await settings.set("CAM_EXPMODE", "Manual")
        await settings.set("CAM_ISO", 1600)
        shelf.sent.clear()
        await settings.set("CAM_EXPMODE", "Auto")
        asked = [request.param_id for request in shelf.all(m.ParamExtRequestRead)]
        assert asked == ["CAM_ISO", "CAM_SHUTTER", "CAM_EV"]
        assert settings.table["CAM_ISO"].value == shelf.values["CAM_ISO"] == 200


async def test_unreadable_dependent_setting_is_forgotten() -> None:
    async with on_board() as shelf:
        settings = shelf.settings
        await settings.fetch_definition()
        await settings.download()
        shelf.camera.faults.mute_parameters.add("CAM_ISO")
        await settings.set("CAM_EXPMODE", "Manual", idle_timeout_s=4.0)
        assert settings.known("CAM_ISO") is None
        assert settings.known("CAM_EV") is not None


async def test_write_only_setting_is_not_read() -> None:
    pin = b'<parameter name="CAM_PIN" type="uint32" writeonly="1"/></parameters>'
    async with on_board(definition=own_definition().replace(b"</parameters>", pin)) as shelf:
        await shelf.settings.fetch_definition()
        assert (await shelf.settings.set("CAM_PIN", 1234)).value == shelf.values["CAM_PIN"] == 1234
        assert shelf.all(m.ParamExtRequestRead) == []


async def test_settings_without_definition_are_sent_unchanged() -> None:
    async with on_board() as shelf:
        text = own_definition().replace(b'name="CAM_WBMODE"', b'name="CAM_OTHER"')
        shelf.camera.files.put("/other.xml", text)
        await shelf.settings.fetch_definition("mftp:///other.xml")
        assert (await shelf.settings.set("CAM_WBMODE", 4)).value == 4


async def test_simulated_camera_refuses_disallowed_values() -> None:
    """Bypass the definition by sending a message."""
    async with on_board() as shelf:
        await shelf.component.command(MavCmd.VIDEO_STOP_CAPTURE, 0)
        with pytest.raises(ParameterRejected) as caught:
            await shelf.settings.set("CAM_ISO", 100)
        assert caught.value.code == ParamAck.FAILED
        await shelf.component.command(MavCmd.IMAGE_START_CAPTURE, 0, 1, 0)
        with pytest.raises(ParameterRejected):
            await shelf.settings.set("CAM_MODE", 1)
        await shelf.component.command(MavCmd.IMAGE_STOP_CAPTURE, 0)
        await shelf.settings.set("CAM_WBMODE", 5)
        await shelf.component.command(MavCmd.RESET_CAMERA_SETTINGS, 1)
        assert await shelf.settings.get("CAM_WBMODE") == 0


# ------------------------------------------------------------------------- files of components


async def test_component_files() -> None:
    async with on_board(SimulatedCamera(101)) as shelf:
        shelf.camera.files.put("/DCIM/0001.jpg", bytes(range(256)) * 40)
        files = shelf.component.files
        assert [file.name for file in await files.list("/DCIM")] == ["0001.jpg"]
        assert await files.read("/DCIM/0001.jpg") == bytes(range(256)) * 40
        await files.write("/notes.txt", b"seen")
        assert shelf.camera.files.get("/notes.txt") == b"seen"
        with pytest.raises(FileError):
            await shelf.vehicle.component(101).files.read("/DCIM/0001.jpg")
        assert await shelf.vehicle.files.list("/APM") is not None
