"""``component.settings``: settings of a component, explained by a camera definition file.

https://mavlink.io/en/services/parameter_ext.html, https://mavlink.io/en/services/camera_def.html
"""

from __future__ import annotations

import asyncio
import os
from types import MappingProxyType
from typing import TYPE_CHECKING

from aerokit._internal.arguments import checks_arguments
from aerokit.errors import NotSupported, ParameterRejected
from aerokit.events import SettingChanged
from aerokit.mavlink import messages as m
from aerokit.mavlink.enums import ParamAck
from aerokit.parameters import Setting, SettingValue, check_name
from aerokit.parameters.parameter import MAX_PARAMETERS, checked_setting, settings_equal
from aerokit.protocols.exchange import IDLE_TIMEOUT_S
from aerokit.protocols.extended_parameters import SettingList, SettingReads, SettingWrite, setting_of

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterable, Mapping

    from aerokit.parameters import CameraDefinition, SettingDefinition
    from aerokit.protocols.exchange import OnProgress
    from aerokit.protocols.extended_parameters import SettingAnswer
    from aerokit.vehicle.components.session import ComponentSession
    from aerokit.vehicle.files.files import Files
    from aerokit.vehicle.session.session import VehicleSession

__all__ = ["Settings"]

# Standard name of the camera mode setting. CAMERA_SETTINGS also reports its value.
MODE_SETTING = "CAM_MODE"


@checks_arguments
class Settings:
    """The settings of one component. Coroutines exchange messages with the component; ``table`` is the local copy.

    Every PARAM_EXT_VALUE and PARAM_EXT_ACK of the component updates the table, whoever changed the setting. Each
    change of a value is published as :class:`aerokit.events.SettingChanged`. A reboot of the vehicle clears the table.

    A camera definition file explains the settings: :meth:`fetch_definition` reads it from the camera, :meth:`load`
    from a local file. From then on you can use the names of options, and values that are out of range or excluded by
    other settings are refused before anything is sent. Without a definition, values are sent unchanged.

    Methods that send something take ``idle_timeout_s`` (they fail after this many seconds without progress) and
    ``timeout`` (seconds in total; then they raise OperationTimeout). You can cancel any call.
    """

    def __init__(
        self,
        session: ComponentSession | VehicleSession,
        information: Callable[[], Awaitable[m.CameraInformation]],
        files_of: Callable[[int], Files],
    ) -> None:
        self._transfers = session.transfers
        self._request_information = information
        # Returns the files of the component with the given id.
        self._files_of = files_of
        self._known: dict[str, Setting] = {}
        self._missing: set[str] = set()  # names of settings that the component does not have
        self._in_doubt: set[str] = set()  # settings whose last write was cancelled or not confirmed
        self._is_complete = False
        self._reboots = 0  # number of reboots of the vehicle so far
        self._definition: CameraDefinition | None = None
        self._download_lock = asyncio.Lock()
        self._write_lock = asyncio.Lock()
        session.subscriber.listen(m.ParamExtValue, lambda message: self._store(setting_of(message)))
        session.subscriber.listen(m.ParamExtAck, self._on_ack)
        session.subscriber.listen(m.CameraSettings, self._on_mode)
        session.on_reboot.append(self._forget)

    @property
    def table(self) -> Mapping[str, Setting]:
        """Known settings by name; empty before the first read, and after a reboot."""
        return MappingProxyType(dict(self._known))

    @property
    def is_complete(self) -> bool:
        """True if the whole list was downloaded since the vehicle started."""
        return self._is_complete

    def known(self, name: str) -> Setting | None:
        """Return the last known value of a setting; None if unknown."""
        return self._known.get(name)

    @property
    def definition(self) -> CameraDefinition | None:
        """The camera definition, once it is loaded."""
        return self._definition

    def load(
        self, definition: CameraDefinition | str | os.PathLike[str], *, locale: str | None = None
    ) -> CameraDefinition:
        """Set the camera definition that describes the settings.

        Args:
            definition: the definition, or the path of its file (``.xml`` or ``.xml.xz``).
            locale: language of descriptions and option names, such as ``"de"`` or ``"de_DE"``. Texts without a
                translation are unchanged.

        Raises:
            FileFormatError: as for :func:`aerokit.parameters.load_definition`. The previous definition is kept.
            OSError: the file cannot be read. The previous definition is kept.
        """
        from aerokit.parameters import load_definition

        if isinstance(definition, (str, os.PathLike)):
            definition = load_definition(definition)
        self._definition = definition if locale is None else definition.localized(locale)
        for name, setting in self._known.items():
            self._known[name] = self._with_definition(setting)
        return self._definition

    async def fetch_definition(
        self,
        uri: str | None = None,
        *,
        locale: str | None = None,
        idle_timeout_s: float = IDLE_TIMEOUT_S,
        timeout: float | None = None,
    ) -> CameraDefinition:
        """Fetch the definition file that the camera names, and use it from then on, like :meth:`load`.

        Args:
            uri: address of the file: ``mftp://`` is MAVFTP, ``mftp://[;comp=1]/…`` on another component; ``http://``
                and ``https://`` are fetched from the web. The default is the address in CAMERA_INFORMATION.
            locale: as for :meth:`load`.
            idle_timeout_s: fail after this many seconds without progress.
            timeout: seconds in total. A download from the web ends after one minute in any case.

        Raises:
            NotSupported: the camera names no definition file.
            CommandRejected, OperationTimeout: the camera did not send CAMERA_INFORMATION.
            InvalidArgument: the address has another scheme.
            FileFormatError: as for :func:`aerokit.parameters.load_definition`.
            FileError, FileTimeout, RemoteProtocolError: as for :meth:`aerokit.vehicle.files.files.Files.read`.
            OperationRejected: the web server failed.
        """
        from aerokit.parameters import parse_definition
        from aerokit.vehicle.components.session import fetch

        with self._transfers.limit(timeout):
            if uri is None:
                uri = (await self._request_information()).cam_definition_uri
            if not uri:
                raise NotSupported(
                    f"component {self._transfers.component_id} names no definition file, so there is none to fetch; its"
                    " settings can be read and set by name"
                )
            data = await fetch(uri, self._files_of, self._transfers.component_id, idle_timeout_s)
            return self.load(parse_definition(data, uri), locale=locale)

    def options(self, name: str) -> Mapping[str, SettingValue]:
        """Return the present options of a setting as {name: value}; empty without a definition or without options.

        The known values of other settings may exclude some options.
        """
        if self._definition is None:
            return MappingProxyType({})
        options = self._definition.options(name, self._values())
        return MappingProxyType({option.name: option.value for option in options})

    def excluded_by(self, name: str) -> tuple[str, ...]:
        """Return the values of other settings that make a setting unavailable now, e.g. ``("CAM_EXPMODE = Auto",)``."""
        return () if self._definition is None else self._definition.excluded_by(name, self._values())

    async def download(
        self,
        *,
        refresh: bool = False,
        idle_timeout_s: float = IDLE_TIMEOUT_S,
        timeout: float | None = None,
        on_progress: OnProgress | None = None,
    ) -> Mapping[str, Setting]:
        """Return all settings by name, in the component's order. Download them if they are not complete yet.

        ``refresh`` downloads them in any case.

        Raises:
            ParameterTimeout: the list is incomplete, or the component has no settings. The error's ``table`` has the
                settings that arrived.
        """
        transfers = self._transfers
        with transfers.limit(timeout):
            async with self._download_lock:
                while refresh or not self._is_complete:
                    reboots_before = self._reboots
                    exchange = SettingList(
                        transfers.system_id,
                        transfers.component_id,
                        round_trip=transfers.round_trip,
                        idle_timeout_s=idle_timeout_s,
                        on_progress=on_progress,
                    )
                    listed = await transfers.run(exchange)
                    if self._reboots != reboots_before:
                        continue  # A part of the list is from before the reboot.
                    # Keep the order of the list, but the values of messages that have arrived during the download.
                    self._known = {**listed, **self._known}
                    self._is_complete = True
                    break
                return self.table

    async def get(
        self, name: str, *, idle_timeout_s: float = IDLE_TIMEOUT_S, timeout: float | None = None
    ) -> SettingValue:
        """Request one setting from the component; for arguments and errors see :meth:`read`."""
        return (await self.read(name, idle_timeout_s=idle_timeout_s, timeout=timeout)).value

    async def read(self, name: str, *, idle_timeout_s: float = IDLE_TIMEOUT_S, timeout: float | None = None) -> Setting:
        """Request one setting from the component, bypassing the local copy in ``table``.

        Raises:
            InvalidArgument: the name is empty, or longer than 16 characters.
            ParameterRejected: the component answers for other settings, but not for this one.
            ParameterTimeout: there was no answer.
        """
        check_name(name)
        with self._transfers.limit(timeout):
            answers = await self._read([name], idle_timeout_s)
            return self._with_definition(_setting_or_raise(answers[name]))

    async def set(
        self,
        name: str,
        value: float | str | bytes,
        *,
        idle_timeout_s: float = IDLE_TIMEOUT_S,
        timeout: float | None = None,
    ) -> Setting:
        """Set one setting and return the value that the component confirms, which may differ from ``value``.

        If the camera definition is loaded, ``value`` may be the name of an option. aerokit then first reads the
        settings that restrict this one, if their values are unknown. Afterwards, it reads the settings that the camera
        may have changed.

        Raises:
            InvalidArgument: the name or value is invalid, or the definition does not allow this value now. Nothing was
                set.
            ParameterRejected: the component has no such setting, or refused; ``code`` is the PARAM_ACK in its answer.
            ParameterTimeout: the component did not confirm the value, but may have set it; or the settings that the
                camera may have changed could not be read again.
        """
        check_name(name)
        with self._transfers.limit(timeout):
            async with self._write_lock:
                setting_definition = self._definition_of(name)
                if setting_definition is None:
                    return self._with_definition(await self._write_undefined(name, value, idle_timeout_s))
                confirmed = await self._write_defined(setting_definition, value, idle_timeout_s)
                if setting_definition.updates:
                    await self._read_again(setting_definition.updates, idle_timeout_s)
                return self._with_definition(confirmed)

    async def _write_undefined(self, name: str, value: object, idle_timeout_s: float) -> Setting:
        present = self._known.get(name)
        if present is None or name in self._in_doubt:
            answers = await self._read([name], idle_timeout_s)
            present = _setting_or_raise(answers[name])
        raw_value = checked_setting(name, value, present.type)
        return await self._write(name, raw_value, present.type, present.value, idle_timeout_s)

    async def _write_defined(
        self, setting_definition: SettingDefinition, value: object, idle_timeout_s: float
    ) -> Setting:
        definition, name = self._definition, setting_definition.name
        assert definition is not None
        # Before anything is sent, refuse a value that the known values of other settings exclude already.
        definition.checked(name, value, self._values())
        await self._read_before_write(definition, setting_definition, idle_timeout_s)
        # Check the value again, because the values that were just read may exclude or restrict this setting.
        checked_value = definition.checked(name, value, self._values())
        present = self._known.get(name)
        wire_type = setting_definition.wire_type if present is None else present.type
        old_value = None if present is None else present.value
        raw_value = checked_setting(name, checked_value, wire_type)
        return await self._write(name, raw_value, wire_type, old_value, idle_timeout_s)

    async def _read_before_write(
        self, definition: CameraDefinition, setting_definition: SettingDefinition, idle_timeout_s: float
    ) -> None:
        """Read the setting itself, and the settings that restrict it, if their values are unknown."""
        name = setting_definition.name
        restricting_names = definition.dependencies(name)
        to_read = [other for other in restricting_names if self._must_be_read(definition.settings[other])]
        is_unknown = name not in self._known or name in self._in_doubt
        if is_unknown and not setting_definition.write_only:
            to_read.append(name)
        answers = await self._read(to_read, idle_timeout_s) if to_read else {}
        for answered_name, answer in answers.items():
            if isinstance(answer, ParameterRejected):
                self._missing.add(answered_name)
        if name in answers:
            _setting_or_raise(answers[name])  # Raise an error if the component does not have this setting.

    async def _write(
        self, name: str, value: SettingValue, wire_type: int, old_value: SettingValue | None, idle_timeout_s: float
    ) -> Setting:
        transfers = self._transfers
        exchange = SettingWrite(
            transfers.system_id,
            transfers.component_id,
            name,
            value,
            wire_type,
            before=old_value,
            round_trip=transfers.round_trip,
            idle_timeout_s=idle_timeout_s,
        )
        self._in_doubt.add(name)
        confirmed = await transfers.run(exchange)
        self._in_doubt.discard(name)
        return confirmed

    async def _read(self, names: Iterable[str], idle_timeout_s: float) -> dict[str, SettingAnswer]:
        transfers = self._transfers
        exchange = SettingReads(
            transfers.system_id,
            transfers.component_id,
            names,
            round_trip=transfers.round_trip,
            idle_timeout_s=idle_timeout_s,
        )
        return await transfers.run(exchange)

    async def _read_again(self, names: Iterable[str], idle_timeout_s: float) -> None:
        assert self._definition is not None
        settings = self._definition.settings
        readable = [name for name in names if name in settings and not settings[name].write_only]
        answers = await self._read(readable, idle_timeout_s)
        for name, answer in answers.items():
            if not isinstance(answer, Setting):
                self._known.pop(name, None)

    def _values(self) -> dict[str, SettingValue]:
        return {name: setting.value for name, setting in self._known.items()}

    def _must_be_read(self, setting: SettingDefinition) -> bool:
        was_read = setting.name in self._known or setting.name in self._missing or self._is_complete
        return not was_read and not setting.write_only

    def _definition_of(self, name: str) -> SettingDefinition | None:
        return None if self._definition is None else self._definition.settings.get(name)

    def _with_definition(self, setting: Setting) -> Setting:
        """Convert the setting's value to the type in its definition, if there is one."""
        setting_definition = self._definition_of(setting.name)
        if setting_definition is None:
            return setting
        return setting.replace(value=setting_definition.convert(setting.value))

    def _on_ack(self, message: m.ParamExtAck) -> None:
        if message.param_result == ParamAck.ACCEPTED:
            self._store(setting_of(message))

    def _on_mode(self, message: m.CameraSettings) -> None:
        # A command that sets the camera mode also changes this setting.
        known = self._known.get(MODE_SETTING)
        if known is not None and isinstance(known.value, int):
            self._store(known.replace(value=message.mode_id))

    def _store(self, setting: Setting) -> None:
        old = self._known.get(setting.name)
        if not setting.name or (old is None and len(self._known) >= MAX_PARAMETERS):
            return  # A faulty component may send empty names, or new names without end.
        if setting.index is None and old is not None:  # PARAM_EXT_ACK has no index.
            setting = setting.replace(index=old.index)
        new = self._known[setting.name] = self._with_definition(setting)
        if old is not None and not settings_equal(old.value, new.value):
            transfers, now = self._transfers, self._transfers.connection.now()
            event = SettingChanged(now, transfers.system_id, new.name, old.value, new.value, transfers.component_id)
            transfers.connection.bus.publish(event)

    def _forget(self) -> None:
        self._known.clear()
        self._missing.clear()
        self._is_complete = False
        self._reboots += 1


def _setting_or_raise(answer: SettingAnswer) -> Setting:
    if isinstance(answer, Setting):
        return answer
    raise answer
