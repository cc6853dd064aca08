"""``component.settings``: parameters by the extended protocol, explained by a camera's definition file.

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
from aerokit.parameters.parameter import MOST_PARAMETERS
from aerokit.parameters.setting import checked_setting, settings_equal
from aerokit.protocols.exchange import PATIENCE_S
from aerokit.protocols.extended_parameters import SettingList, SettingReads, SettingWrite, setting_of

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterable, Mapping

    from aerokit.parameters import CameraDefinition, SettingDefinition
    from aerokit.protocols.exchange import OnProgress
    from aerokit.protocols.extended_parameters import SettingAnswer
    from aerokit.vehicle.components.session import ComponentTalk
    from aerokit.vehicle.files.files import Files
    from aerokit.vehicle.session.session import Talk

__all__ = ["Settings"]

MODE = "CAM_MODE"
"""The standard's name of the setting that CAMERA_SETTINGS tells, too."""


@checks_arguments
class Settings:
    """The settings of one component. Coroutines talk to it; ``table`` is what is known, and never does.

    Every PARAM_EXT_VALUE and PARAM_EXT_ACK of the component keeps the table up to date, also when somebody else has
    changed something, and is told as :class:`aerokit.events.SettingChanged`. After a reboot of the vehicle nothing is
    known until it is read anew.

    A camera's settings are explained by its definition file: :meth:`fetch_definition` has it from the camera,
    :meth:`load` takes one that is here. From then on options go by their names, and what is out of range or excluded
    by other settings is refused before anything is sent. Without it each value is sent as it is.

    All methods take ``patience_s`` (give up after so many seconds without anything new) and ``timeout`` (for all of
    it; then OperationTimeout), if they talk to the component. Each can be cancelled at any moment.
    """

    def __init__(
        self,
        talk: ComponentTalk | Talk,
        information: Callable[[], Awaitable[m.CameraInformation]],
        files_of: Callable[[int], Files],
    ) -> None:
        self._transfers = talk.transfers
        self._information, self._files_of = information, files_of
        self._known: dict[str, Setting] = {}
        self._absent: dict[str, None] = {}
        self._is_complete = False
        self._definition: CameraDefinition | None = None
        self._downloading, self._writing = asyncio.Lock(), asyncio.Lock()
        talk.hearing.listen(m.ParamExtValue, self._on_value)
        talk.hearing.listen(m.ParamExtAck, self._on_ack)
        talk.hearing.listen(m.CameraSettings, self._on_mode)
        talk.on_reboot.append(self._forget)

    # ---------------------------------------------------------------------------- what is known

    @property
    def table(self) -> Mapping[str, Setting]:
        """What is known now, by name; empty before anything was read, and after a reboot."""
        return MappingProxyType(dict(self._known))

    @property
    def is_complete(self) -> bool:
        """Whether the whole list was downloaded since the vehicle started."""
        return self._is_complete

    def known(self, name: str) -> Setting | None:
        """What was told last of a setting; None when nothing was."""
        return self._known.get(name)

    # ----------------------------------------------------------------------- the definition file

    @property
    def definition(self) -> CameraDefinition | None:
        """What the camera's file says of its settings, once it is here."""
        return self._definition

    def load(
        self, definition: CameraDefinition | str | os.PathLike[str], *, locale: str | None = None
    ) -> CameraDefinition:
        """Take a definition, or read it from a file (``.xml`` or ``.xml.xz``).

        Args:
            definition: made by :func:`aerokit.parameters.parse_definition`, or the path of a file.
            locale: language of descriptions and of the names of options, ``"de"`` or ``"de_DE"``, if the file has it.

        Raises:
            FileFormatError: the file is none, or has more than 16 MB. What was there before stays.
        """
        from aerokit.parameters import load_definition

        if isinstance(definition, (str, os.PathLike)):
            definition = load_definition(definition)
        self._definition = definition if locale is None else definition.localized(locale)
        for name, setting in self._known.items():
            self._known[name] = self._explained(setting)
        return self._definition

    async def fetch_definition(
        self,
        uri: str | None = None,
        *,
        locale: str | None = None,
        patience_s: float = PATIENCE_S,
        timeout: float | None = None,
    ) -> CameraDefinition:
        """Fetch the camera's own definition file and take it, as :meth:`load` does.

        Args:
            uri: where it is: ``mftp://`` is MAVFTP, ``mftp://[;comp=1]/…`` that of another component; ``http://`` and
                ``https://`` are fetched from the web, wherever that is. By default what CAMERA_INFORMATION says.
            locale: as for :meth:`load`.
            patience_s: give up after so many seconds without anything new.
            timeout: seconds for all of it; from the web it takes a minute at most.

        Raises:
            NotSupported: the camera names no definition file.
            CommandRejected, OperationTimeout: it did not tell what it is.
            InvalidArgument: an address of another kind.
            FileFormatError: what came is none, or has more than 16 MB.
            FileError, FileTimeout, RemoteProtocolError: as for :meth:`aerokit.vehicle.files.files.Files.read`.
            OperationRejected: the web server does not give it.
        """
        from aerokit.parameters import parse_definition
        from aerokit.vehicle.components.session import fetch

        with self._transfers.limit(timeout):
            if uri is None:
                uri = (await self._information()).cam_definition_uri
            if not uri:
                raise NotSupported(
                    f"component {self._transfers.component_id} names no definition file: its settings can be read"
                    " and set without"
                )
            data = await fetch(uri, self._files_of, self._transfers.component_id, patience_s)
            return self.load(parse_definition(data, uri), locale=locale)

    def options(self, name: str) -> Mapping[str, SettingValue]:
        """The options that a setting has now, name → value, as the other settings allow it by what is known of them.

        Empty where any value in its range may be set, and without a definition.
        """
        if self._definition is None:
            return MappingProxyType({})
        found = self._definition.options(name, self._values())
        return MappingProxyType({each.name: each.value for each in found})

    def excluded_by(self, name: str) -> tuple[str, ...]:
        """What makes a setting mean nothing now, by what is known of the others: ``("CAM_EXPMODE = Auto",)``."""
        return () if self._definition is None else self._definition.excluded_by(name, self._values())

    # -------------------------------------------------------------------------------- reading

    async def download(
        self,
        *,
        refresh: bool = False,
        patience_s: float = PATIENCE_S,
        timeout: float | None = None,
        on_progress: OnProgress | None = None,
    ) -> Mapping[str, Setting]:
        """Return all settings by name, in the component's order; at once when they were downloaded before.

        Raises:
            ParameterTimeout: the list did not come whole, or the component has none. What did come is in ``table``.
        """
        transfers = self._transfers
        with transfers.limit(timeout):
            async with self._downloading:
                if refresh or not self._is_complete:
                    exchange = SettingList(
                        transfers.system_id,
                        transfers.component_id,
                        round_trip=transfers.round_trip,
                        patience_s=patience_s,
                        on_progress=on_progress,
                    )
                    found = await transfers.run(exchange)
                    others = {name: each for name, each in self._known.items() if name not in found}
                    self._known = {name: self._known.get(name, found[name]) for name in found} | others
                    self._is_complete = True
                return self.table

    async def get(
        self, name: str, *, patience_s: float = PATIENCE_S, timeout: float | None = None
    ) -> SettingValue:
        """Ask the component for one value; the rest is as for :meth:`read`."""
        return (await self.read(name, patience_s=patience_s, timeout=timeout)).value

    async def read(
        self, name: str, *, patience_s: float = PATIENCE_S, timeout: float | None = None
    ) -> Setting:
        """Ask the component for one setting; ``table[name]`` is what is known without asking.

        Raises:
            InvalidArgument: the name is none, or longer than 16 characters.
            ParameterRejected: the component answers for other settings, and not for this one.
            ParameterTimeout: no answer.
        """
        check_name(name)
        with self._transfers.limit(timeout):
            return self._explained(_found((await self._read([name], patience_s))[name]))

    # -------------------------------------------------------------------------------- writing

    async def set(
        self,
        name: str,
        value: float | str | bytes,
        *,
        patience_s: float = PATIENCE_S,
        timeout: float | None = None,
    ) -> Setting:
        """Set one setting, and return what the component says it is then; it may have taken another value.

        With a definition ``value`` may be the name of an option, and settings that may change with this one are read
        again before it returns. What decides on this setting and is not known yet is read before.

        Raises:
            InvalidArgument: a name or value that cannot be; with a definition: an option or a value that is not
                allowed, a setting that can only be read or is excluded now. It was not set.
            ParameterRejected: the component has no such setting, or refused; ``code`` is its PARAM_ACK.
            ParameterTimeout: not confirmed. It may have been set all the same.
        """
        check_name(name)
        with self._transfers.limit(timeout):
            async with self._writing:
                own = None if self._definition is None else self._definition.settings.get(name)
                told = await (
                    self._write_unexplained(name, value, patience_s)
                    if own is None
                    else self._write_explained(own, value, patience_s)
                )
                if own is not None and own.updates:
                    await self._read_again(own.updates, patience_s)
                return self._explained(told)

    async def _write_unexplained(self, name: str, value: object, patience_s: float) -> Setting:
        known = self._known.get(name)
        if known is None:
            known = _found((await self._read([name], patience_s))[name])
        wanted = checked_setting(name, value, known.type)
        return await self._write(name, wanted, known.type, known.value, patience_s)

    async def _write_explained(self, own: SettingDefinition, value: object, patience_s: float) -> Setting:
        definition = self._definition
        assert definition is not None
        definition.checked(own.name, value, self._values())
        asked = [
            name for name in definition.rulers(own.name) if self._is_to_be_read(definition.settings[name])
        ]
        if own.name not in self._known and not own.write_only:
            asked.append(own.name)
        answers = await self._read(asked, patience_s) if asked else {}
        self._absent |= {name: None for name, each in answers.items() if isinstance(each, ParameterRejected)}
        if own.name in answers:
            _found(answers[own.name])
        wanted = definition.checked(own.name, value, self._values())
        known = self._known.get(own.name)
        kind = own.wire_type if known is None else known.type
        before = None if known is None else known.value
        return await self._write(own.name, checked_setting(own.name, wanted, kind), kind, before, patience_s)

    async def _write(
        self, name: str, value: SettingValue, kind: int, before: SettingValue | None, patience_s: float
    ) -> Setting:
        transfers = self._transfers
        exchange = SettingWrite(
            transfers.system_id,
            transfers.component_id,
            name,
            value,
            kind,
            before=before,
            round_trip=transfers.round_trip,
            patience_s=patience_s,
        )
        return await transfers.run(exchange)

    async def _read(self, names: Iterable[str], patience_s: float) -> dict[str, SettingAnswer]:
        transfers = self._transfers
        exchange = SettingReads(
            transfers.system_id,
            transfers.component_id,
            names,
            round_trip=transfers.round_trip,
            patience_s=patience_s,
        )
        return await transfers.run(exchange)

    async def _read_again(self, names: Iterable[str], patience_s: float) -> None:
        """What cannot be read any more is not known any more: it may have changed."""
        assert self._definition is not None
        settings = self._definition.settings
        wanted = [name for name in names if name in settings and not settings[name].write_only]
        for name, answer in (await self._read(wanted, patience_s)).items():
            if not isinstance(answer, Setting):
                self._known.pop(name, None)

    # ------------------------------------------------------------------------------- what comes

    def _values(self) -> dict[str, SettingValue]:
        return {name: each.value for name, each in self._known.items()}

    def _is_to_be_read(self, setting: SettingDefinition) -> bool:
        is_told = setting.name in self._known or setting.name in self._absent or self._is_complete
        return not is_told and not setting.write_only

    def _explained(self, setting: Setting) -> Setting:
        own = None if self._definition is None else self._definition.settings.get(setting.name)
        return setting if own is None else setting.replace(value=own.typed(setting.value))

    def _on_value(self, message: m.ParamExtValue) -> None:
        self._take(setting_of(message))

    def _on_ack(self, message: m.ParamExtAck) -> None:
        if message.param_result == ParamAck.ACCEPTED:
            self._take(setting_of(message))

    def _on_mode(self, message: m.CameraSettings) -> None:
        """A mode that was set by a command is the value of this setting, too."""
        known = self._known.get(MODE)
        if known is not None and isinstance(known.value, int):
            self._take(known.replace(value=message.mode_id))

    def _take(self, setting: Setting) -> None:
        before = self._known.get(setting.name)
        if not setting.name or (before is None and len(self._known) >= MOST_PARAMETERS):
            return
        if setting.index is None and before is not None:
            setting = setting.replace(index=before.index)
        after = self._known[setting.name] = self._explained(setting)
        if before is not None and not settings_equal(before.value, after.value):
            transfers = self._transfers
            transfers.connection.bus.publish(
                SettingChanged(
                    transfers.connection.now(),
                    transfers.system_id,
                    after.name,
                    before.value,
                    after.value,
                    transfers.component_id,
                )
            )

    def _forget(self) -> None:
        self._known.clear()
        self._absent.clear()
        self._is_complete = False


def _found(answer: SettingAnswer) -> Setting:
    """What was read, or the reason why nothing was, raised."""
    if isinstance(answer, Setting):
        return answer
    raise answer
