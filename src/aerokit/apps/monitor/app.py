"""``Monitor``: the Textual application of ``aerokit monitor``."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, ClassVar

from rich.table import Table
from rich.text import Text
from textual.app import App
from textual.binding import Binding
from textual.containers import Horizontal, Vertical
from textual.screen import ModalScreen
from textual.widgets import Button, Footer, Label, OptionList, RichLog, Static
from textual.widgets.option_list import Option

from aerokit.apps.monitor.lines import ARROWS, UNKNOWN, Canvas, list_row, state_lines
from aerokit.apps.monitor.model import MonitorModel
from aerokit.connection.opening import OBSERVER_SYSTEM_ID, explain_no_vehicle, open_connection
from aerokit.connection.tasks import BackgroundTasks
from aerokit.errors import AerokitError
from aerokit.vehicle.connect import vehicles_on

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import PurePath

    from textual.app import ComposeResult
    from textual.binding import BindingType

    from aerokit.mavlink.signing import Signing
    from aerokit.transport.link import Link
    from aerokit.vehicle.vehicle import Vehicle

__all__ = ["ConfirmScreen", "Monitor", "run_monitor"]

REFRESH_INTERVAL_S = 0.25
TRACK_STYLES = ("cyan", "magenta", "yellow", "green", "blue", "red")
KEY_COMMANDS = {"hold": "HOLD", "land": "LAND", "return_to_launch": "RETURN TO LAUNCH"}
"""Vehicle methods that keys call, and their names in the question."""


class ConfirmScreen(ModalScreen[bool]):
    """A yes/no question. Returns True for "y" or the button Yes; Enter alone is No."""

    BINDINGS: ClassVar[list[BindingType]] = [
        ("y", "answer(True)", "Yes"),
        ("n,escape,q", "answer(False)", "No"),
        ("left", "app.focus_previous", "Other"),
        ("right", "app.focus_next", "Other"),
    ]
    CSS: ClassVar[str] = """
    ConfirmScreen { align: center middle; }
    ConfirmScreen Vertical { width: 50; height: auto; border: heavy $warning; background: $surface; padding: 1 2; }
    ConfirmScreen Label { width: 100%; text-align: center; text-style: bold; }
    ConfirmScreen Horizontal { height: auto; align: center middle; margin-top: 1; }
    ConfirmScreen Button { margin: 0 2; }
    """

    def __init__(self, text: str) -> None:
        super().__init__()
        self.text = text
        """The question."""

    def compose(self) -> ComposeResult:
        """Yield the question and two buttons; No is first and focused."""
        with Vertical():
            yield Label(self.text, markup=False)
            with Horizontal():
                yield Button("No (n)", id="no")
                yield Button("Yes (y)", id="yes", variant="warning")

    def on_mount(self) -> None:
        """Focus the button No."""
        self.query_one("#no").focus()

    def on_button_pressed(self, event: Button.Pressed) -> None:
        """Return the answer of a button."""
        self.dismiss(event.button.id == "yes")

    def action_answer(self, yes: bool) -> None:
        """Return the answer of a key."""
        self.dismiss(yes)


class Monitor(App[None]):
    """Shows a :class:`~aerokit.apps.monitor.model.MonitorModel`. Commands go to the vehicle named in the question."""

    CSS_PATH: ClassVar[str | PurePath | list[str | PurePath] | None] = "monitor.tcss"
    ENABLE_COMMAND_PALETTE: ClassVar[bool] = False
    BINDINGS: ClassVar[list[BindingType]] = [
        ("h", "command('hold')", "Hold"),
        ("l", "command('land')", "Land"),
        ("r", "command('return_to_launch')", "Return"),
        ("q", "quit", "Quit"),
        Binding("ctrl+c", "quit", "Quit", show=False, priority=True),
    ]

    def __init__(self, model: MonitorModel, commands: BackgroundTasks, name: str) -> None:
        super().__init__()
        self._model, self._commands, self._name = model, commands, name
        self._began_at = model.connection.now()
        self._listed: list[int] = []

    def compose(self) -> ComposeResult:
        """Yield the vehicle list, state and map, texts and rates."""
        yield Static(id="title", markup=False)
        yield OptionList(id="vehicles")
        with Horizontal(id="middle"):
            yield Static(id="state", markup=False)
            yield Static(id="map", markup=False)
        with Horizontal(id="bottom"):
            yield RichLog(id="texts", wrap=True, min_width=1, max_lines=500)
            with Vertical(id="rates_box"):
                yield Static(id="rates", markup=False)
        yield Footer()

    def on_mount(self) -> None:
        """Set titles, and start periodic updates."""
        for name, title in (("state", "state"), ("map", "map"), ("texts", "texts and events")):
            self.query_one(f"#{name}").border_title = title
        self.query_one("#rates_box").border_title = "messages per second"
        self.query_one("#texts").can_focus = False
        self.query_one("#vehicles").focus()
        self.update_view()
        self.set_interval(REFRESH_INTERVAL_S, self.update_view)

    @property
    def selected(self) -> Vehicle | None:
        """The highlighted vehicle; None if there is none."""
        place = self.screen_stack[0].query_one("#vehicles", OptionList).highlighted
        return None if place is None else self._model.vehicles[self._listed[place]]

    def update_view(self) -> None:
        """Update all widgets from the model."""
        self._model.update()
        base = self.screen_stack[0]
        self._list(base.query_one("#vehicles", OptionList))
        views = {"title": self._title, "state": self._state, "map": self._map, "rates": self._rates}
        for name, make_view in views.items():
            base.query_one(f"#{name}", Static).update(make_view())
        texts = base.query_one("#texts", RichLog)
        while self._model.lines:
            texts.write(self._model.lines.popleft())

    def on_option_list_option_highlighted(self) -> None:
        """Show the newly selected vehicle."""
        self.update_view()

    def action_command(self, method: str) -> None:
        """Ask for confirmation, then command the vehicle that is selected now."""
        vehicle = self.selected
        if vehicle is None:
            self.bell()
            return

        def on_answer(yes: bool | None) -> None:
            if yes:
                self._commands.start(partial(self._run_command, vehicle, method))

        self.push_screen(ConfirmScreen(f"{KEY_COMMANDS[method]}: vehicle {vehicle.system_id}?"), on_answer)

    async def _run_command(self, vehicle: Vehicle, method: str) -> None:
        what, note = KEY_COMMANDS[method].lower(), partial(self._model.add_line, vehicle.system_id)
        note(f"{what}: command sent", "bold")
        try:
            await getattr(vehicle, method)()
        except AerokitError as error:
            note(f"{what} failed: {error}", "bold red")
        else:
            note(f"{what}: done", "bold green")

    def _list(self, options: OptionList) -> None:
        vehicles = self._model.vehicles
        for system_id in vehicles:
            if system_id not in self._listed:
                self._listed.append(system_id)
                options.add_option(Option(list_row(vehicles[system_id]), id=str(system_id)))
        if self._listed and options.highlighted is None:
            options.highlighted = 0
        for place, system_id in enumerate(self._listed):
            options.replace_option_prompt_at_index(place, list_row(vehicles[system_id]))

    def _title(self) -> Text:
        connection, count = self._model.connection, len(self._model.vehicles)
        state = connection.link_state.latest
        text = Text(f"{self._name}  ", "bold", no_wrap=True, overflow="ellipsis")
        text.append(f"link {state.value if state else UNKNOWN}  {count} vehicle{'s' if count != 1 else ''}")
        return text

    def _state(self) -> Table | Text:
        vehicle = self.selected
        if vehicle is None:
            waited = self._model.connection.now() - self._began_at
            return Text(
                f"waiting for a vehicle's heartbeat on {self._name} ({waited:.0f} s)\n\n"
                f"{explain_no_vehicle(self._model.connection, None)}"
            )
        table = Table.grid(padding=(0, 1))
        for label, text in state_lines(vehicle):
            table.add_row(Text(label, "dim"), text)
        return table

    def _map(self) -> Text:
        model, widget = self._model, self.screen_stack[0].query_one("#map", Static)
        homes = [
            (home, vehicle)
            for vehicle in model.vehicles.values()
            if (home := vehicle.home.latest) is not None and model.tracks.get(vehicle.system_id)
        ]
        marks = [(model.metres(home.latitude_deg, home.longitude_deg), "H", "bold green") for home, _ in homes]
        points = [point for track in model.tracks.values() for point in track] + [mark[0] for mark in marks]
        if not points:
            return Text("no position known", "dim")
        canvas = Canvas(widget.content_size.width, widget.content_size.height, points)
        for system_id, track in model.tracks.items():
            for point in track:
                canvas.dot(point, self._style_of(system_id))
        for mark in [*marks, *map(self._mark_of, model.tracks)]:
            canvas.mark(*mark)
        widget.border_subtitle = f"{canvas.width_m:.0f} m wide, north up"
        return canvas.text()

    def _mark_of(self, system_id: int) -> tuple[tuple[float, float], str, str]:
        vehicle = self._model.vehicles[system_id]
        heading = vehicle.heading_deg.latest
        arrow = "?" if heading is None else ARROWS[round(heading / 45) % 8]
        style = f"bold {self._style_of(system_id)}" + (" reverse" if vehicle is self.selected else "")
        return self._model.tracks[system_id][-1], f"{arrow}{system_id}", style

    def _style_of(self, system_id: int) -> str:
        return TRACK_STYLES[self._listed.index(system_id) % len(TRACK_STYLES)] if system_id in self._listed else ""

    def _rates(self) -> Text:
        vehicle = self.selected
        if vehicle is None:
            return Text(UNKNOWN, "dim")
        lines = [Text(f"{hz:5.1f} {name}") for name, hz in self._model.rates(vehicle.system_id)]
        return Text("\n", no_wrap=True, overflow="ellipsis").join(lines) if lines else Text(UNKNOWN, "dim")


async def run_monitor(
    address: str | Link,
    *,
    baud: int = 57600,
    signing: Signing | None = None,
    on_start: Callable[[Monitor], object] | None = None,
) -> int:
    """Show the vehicles on a link until the user quits.

    Args:
        address: of the link; a lost link is reopened.
        baud: baud rate of a serial port whose address has none.
        signing: as in :func:`aerokit.open_connection`.
        on_start: called with the application before it runs.

    Returns:
        Exit code: 0, or 1 after an internal error, which the application has shown.

    Raises:
        LinkOpenError: the link cannot be opened.
        AerokitError: the error that ended the connection.
    """
    async with (
        open_connection(
            address, source_system=OBSERVER_SYSTEM_ID, baud=baud, signing=signing, reconnect=isinstance(address, str)
        ) as link,
        vehicles_on(link) as vehicles,
    ):
        model, commands = MonitorModel(link, vehicles), BackgroundTasks(link.fail)
        app = Monitor(model, commands, str(link.link.address))
        detach = link.on_end(lambda error: app.exit())
        try:
            if on_start is not None:
                on_start(app)
            await app.run_async()
            link.raise_if_ended()
            return app.return_code or 0
        finally:
            detach()
            model.close()
            await commands.aclose()
