"""``Monitor``: the Textual application of ``aerokit monitor``."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, ClassVar

from rich.table import Table
from rich.text import Text
from textual.app import App
from textual.binding import Binding
from textual.containers import Container, Horizontal, Vertical, VerticalScroll
from textual.screen import ModalScreen
from textual.widget import Widget
from textual.widgets import Button, Footer, Label, OptionList, RichLog
from textual.widgets.option_list import Option

from aerokit.apps.monitor.lines import ARROWS, LINK_STYLES, UNKNOWN, Canvas, VehicleText, number
from aerokit.apps.monitor.model import MonitorModel
from aerokit.apps.readiness import ArmingCheckRequests, run_arming_checks
from aerokit.connection.opening import OBSERVER_SYSTEM_ID, explain_no_vehicle, open_connection
from aerokit.connection.tasks import BackgroundTasks
from aerokit.errors import AerokitError
from aerokit.vehicle.connect import vehicles_on

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import PurePath

    from textual.app import ComposeResult
    from textual.binding import BindingType
    from textual.events import Resize

    from aerokit.mavlink.signing import Signing
    from aerokit.transport.link import Link
    from aerokit.vehicle.vehicle import Vehicle

__all__ = ["ConfirmScreen", "MissingScreen", "Monitor", "run_monitor"]

REFRESH_INTERVAL_S = 0.5
WIDE_SIZE = 120, 30
"""Minimum columns and rows of a terminal in which less important values are displayed, too."""
TALL_ROWS = 48
"""Minimum rows of a wide terminal in which the state lists all reasons that prevent a flight."""
ANSI_THEMES = ("ansi-dark", "textual-ansi", "textual-dark")
"""Names of the theme that uses the terminal's colours. The name depends on the version of Textual."""
TRACK_STYLES = ("green", "magenta", "red", "blue", "cyan", "yellow")
KEY_COMMANDS = {"hold": "HOLD", "land": "LAND", "return_to_launch": "RETURN TO LAUNCH"}
"""Maps methods of a vehicle that keys call to the names of the commands in the confirmation."""


class ConfirmScreen(ModalScreen[bool]):
    """A yes/no question. Returns True for the key "y" or the button Yes.

    Enter presses the focused button, which is No at first.
    """

    BINDINGS: ClassVar[list[BindingType]] = [
        ("y", "answer(True)", "Yes"),
        ("n,escape,q", "answer(False)", "No"),
        ("left", "app.focus_previous", "Other"),
        ("right", "app.focus_next", "Other"),
    ]
    CSS: ClassVar[str] = """
    ConfirmScreen { align: center middle; background: transparent; }
    ConfirmScreen Vertical { width: 50; height: auto; border: heavy; padding: 1 2; }
    ConfirmScreen Label { width: 100%; text-align: center; text-style: bold; }
    ConfirmScreen Horizontal { height: auto; align: center middle; margin-top: 1; }
    ConfirmScreen Button { margin: 0 2; }
    """

    def __init__(self, text: str) -> None:
        super().__init__()
        self.text = text
        """The question."""

    def compose(self) -> ComposeResult:
        """Yield the question and two buttons, first No, then Yes."""
        with Vertical():
            yield Label(self.text, markup=False)
            with Horizontal():
                yield Button("No (n)", id="no")
                yield Button("Yes (y)", id="yes", variant="warning")

    def on_mount(self) -> None:
        """Focus the button No."""
        self.query_one("#no").focus()

    def on_button_pressed(self, event: Button.Pressed) -> None:
        """Close the screen with the answer of the pressed button."""
        self.dismiss(event.button.id == "yes")

    def action_answer(self, yes: bool) -> None:
        """Close the screen with the answer of the pressed key."""
        self.dismiss(yes)


class MissingScreen(ModalScreen[None]):
    """Lists all reasons that prevent a flight of one vehicle, and updates them. M, Q, Escape and Enter close it."""

    BINDINGS: ClassVar[list[BindingType]] = [("m,escape,q,enter", "dismiss", "Close")]
    CSS: ClassVar[str] = """
    MissingScreen { align: center middle; background: transparent; }
    MissingScreen VerticalScroll { width: 90%; max-width: 100; height: auto; max-height: 90%; border: heavy; }
    MissingScreen Label { width: 100%; }
    """

    def __init__(self, vehicle: Vehicle) -> None:
        super().__init__()
        self._vehicle = vehicle

    def compose(self) -> ComposeResult:
        """Yield a scrollable box with a title, and in it an empty label for the reasons."""
        frame = VerticalScroll(Label(markup=False))
        frame.border_title = f"vehicle {self._vehicle.system_id}: missing"
        yield frame

    def on_mount(self) -> None:
        """Show the reasons, and update them periodically."""
        self.update_reasons()
        self.set_interval(REFRESH_INTERVAL_S, self.update_reasons)

    def update_reasons(self) -> None:
        """Show the present reasons."""
        self.query_one(Label).update(VehicleText(self._vehicle).all_missing())


class Panel(Widget):
    """A widget that shows a text or a table. New content changes the layout only if its height differs."""

    def __init__(self, name: str) -> None:
        super().__init__(id=name)
        self._content: Text | Table = Text()
        self._height = 0

    def show(self, content: Text | Table) -> None:
        height = content.plain.count("\n") if isinstance(content, Text) else content.row_count
        self._content = content
        self.refresh(layout=height != self._height)
        self._height = height

    def render(self) -> Text | Table:
        return self._content


class Monitor(App[None]):
    """Terminal application that shows a :class:`~aerokit.apps.monitor.model.MonitorModel` and commands its vehicles.

    Each command must be confirmed, and goes to the vehicle that the question names.
    """

    CSS_PATH: ClassVar[str | PurePath | list[str | PurePath] | None] = "monitor.tcss"
    ENABLE_COMMAND_PALETTE: ClassVar[bool] = False
    BINDINGS: ClassVar[list[BindingType]] = [
        ("h", "command('hold')", "Hold"),
        ("l", "command('land')", "Land"),
        ("r", "command('return_to_launch')", "Return"),
        ("m", "missing", "Missing"),
        ("q", "quit", "Quit"),
        Binding("ctrl+c", "quit", "Quit", show=False, priority=True),
    ]

    def __init__(self, model: MonitorModel, commands: BackgroundTasks, name: str) -> None:
        super().__init__(ansi_color=True)
        self.theme = next(theme for theme in ANSI_THEMES if theme in self.available_themes)
        self._model = model
        self._commands = commands
        self._name = name
        self._arming_checks = ArmingCheckRequests()
        self._began_at = model.connection.now()
        self._listed_ids: list[int] = []
        self._shown: dict[str, object] = {}
        self._is_wide = False

    def compose(self) -> ComposeResult:
        """Yield the widgets: list of vehicles, state, map, texts and rates."""
        yield Panel("title")
        yield OptionList(id="vehicles")
        with Container(id="panels"):
            yield Panel("state")
            yield Panel("map")
            yield RichLog(id="texts", wrap=True, min_width=1, max_lines=500)
            with Vertical(id="rates_box"):
                yield Panel("rates")
        yield Footer()

    def on_mount(self) -> None:
        """Set the titles of the panels, and start periodic updates."""
        for name, title in (("state", "state"), ("map", "map"), ("texts", "texts and events")):
            self.query_one(f"#{name}").border_title = title
        self.query_one("#rates_box").border_title = "messages per second"
        self.query_one("#texts").can_focus = False
        self.query_one("#vehicles").focus()
        self.update_view()
        self.set_interval(REFRESH_INTERVAL_S, self.update_view)

    def on_resize(self, event: Resize) -> None:
        """Adapt the layout. In a wide terminal, the rates are below the state, and the texts are below the map."""
        base = self.screen_stack[0]
        base.set_class(event.size.height >= TALL_ROWS, "tall")
        min_columns, min_rows = WIDE_SIZE
        is_wide = event.size.width >= min_columns and event.size.height >= min_rows
        if is_wide == self._is_wide:
            return
        self._is_wide = is_wide
        base.set_class(is_wide, "wide")
        panels, rates, texts = (base.query_one(f"#{name}") for name in ("panels", "rates_box", "texts"))
        if is_wide:
            panels.move_child(rates, before=texts)
        else:
            panels.move_child(rates, after=texts)

    @property
    def selected(self) -> Vehicle | None:
        """The highlighted vehicle; None if there is none."""
        index = self.screen_stack[0].query_one("#vehicles", OptionList).highlighted
        return None if index is None else self._model.vehicles[self._listed_ids[index]]

    def update_view(self) -> None:
        """Update the model, request arming checks that are due, and update the widgets whose content has changed."""
        self._model.update()
        self._request_arming_checks()
        base = self.screen_stack[0]
        self._update_list(base.query_one("#vehicles", OptionList))
        self._show("title", self._title())
        state = self._state_content()
        if self._has_changed("state", state):
            base.query_one("#state", Panel).show(_table(state) if isinstance(state, list) else state)
        self._show_map(base.query_one("#map", Panel))
        self._show("rates", self._rates())
        texts = base.query_one("#texts", RichLog)
        while self._model.lines:
            texts.write(self._model.lines.popleft())
        if self._has_changed("slow", self._model.slow_streams):
            texts.border_subtitle = self._model.slow_streams

    def _request_arming_checks(self) -> None:
        for vehicle in self._model.vehicles.values():
            if self._arming_checks.claim_if_due(vehicle):
                self._commands.start(partial(run_arming_checks, vehicle))

    def _has_changed(self, name: str, content: object) -> bool:
        # Drawing only what has changed saves CPU time.
        if self._shown.get(name) == content:
            return False
        self._shown[name] = content
        return True

    def _show(self, name: str, content: Text) -> None:
        if self._has_changed(name, content):
            self.screen_stack[0].query_one(f"#{name}", Panel).show(content)

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

    def action_missing(self) -> None:
        """Show everything that is missing for a flight of the selected vehicle."""
        vehicle = self.selected
        if vehicle is None:
            self.bell()
        elif len(self.screen_stack) == 1:
            self.push_screen(MissingScreen(vehicle))

    async def _run_command(self, vehicle: Vehicle, method: str) -> None:
        command = KEY_COMMANDS[method].lower()
        add_line = partial(self._model.add_line, vehicle.system_id)
        add_line(f"{command}: sending", "bold")
        try:
            await getattr(vehicle, method)()
        except AerokitError as error:
            add_line(f"{command} failed: {error}", "bold red")
        else:
            # `hold` returns when the vehicle reports the mode. A PX4 vehicle may still be moving then.
            outcome = f"in {vehicle.mode_name}, may still be stopping" if method == "hold" else "done"
            add_line(f"{command}: {outcome}", "bold green")

    def _update_list(self, options: OptionList) -> None:
        vehicles = self._model.vehicles
        for system_id in vehicles:
            if system_id not in self._listed_ids:
                self._listed_ids.append(system_id)
                options.add_option(Option("", id=str(system_id)))
        if self._listed_ids and options.highlighted is None:
            options.highlighted = 0
        for index, system_id in enumerate(self._listed_ids):
            is_selected = index == options.highlighted
            row = VehicleText(vehicles[system_id]).list_row(is_selected=is_selected, more=self._is_wide)
            if self._has_changed(f"row {index}", row):
                options.replace_option_prompt_at_index(index, row)

    def _title(self) -> Text:
        state = self._model.connection.link_state.latest
        text = Text(f"{self._name}  link ", "bold", no_wrap=True, overflow="ellipsis")
        text.append(state.value if state else UNKNOWN, LINK_STYLES[state] if state else "")
        count = len(self._model.vehicles)
        return text.append(f"  {count} vehicle{'s' if count != 1 else ''}")

    def _state_content(self) -> list[tuple[str, Text]] | Text:
        vehicle = self.selected
        if vehicle is not None:
            size = self.screen_stack[0].query_one("#state", Panel).content_size
            return VehicleText(vehicle).rows(more=self._is_wide, size=(size.width, size.height))
        waited_s = self._model.connection.now() - self._began_at
        return Text(
            f"waiting for a vehicle's heartbeat on {self._name} ({waited_s:.0f} s)\n\n"
            f"{explain_no_vehicle(self._model.connection, wanted_system=None)}"
        )

    def _show_map(self, widget: Panel) -> None:
        model = self._model
        size = widget.content_size
        homes = []
        for vehicle in model.vehicles.values():  # without a track, a home is not shown
            home = vehicle.home.latest
            if home is not None and model.tracks.get(vehicle.system_id):
                homes.append(model.metres(home.latitude_deg, home.longitude_deg))
        marks = [*((home, "H", "bold") for home in homes), *map(self._mark_of, model.tracks)]
        if not self._has_changed("map", (size, marks, [len(track) for track in model.tracks.values()])):
            return
        points = list(homes)
        for track in model.tracks.values():
            points += track
        if not points:
            widget.show(Text("no position known", "dim"))
            return
        canvas = Canvas(size.width, size.height, points)
        for system_id, track in model.tracks.items():
            canvas.line(track, self._style_of(system_id))
        for point, text, style in marks:
            canvas.mark(point, text, style)
        widget.show(canvas.text())

    def _mark_of(self, system_id: int) -> tuple[tuple[float, float], str, str]:
        vehicle = self._model.vehicles[system_id]
        heading = vehicle.heading_deg.latest
        arrow = "?" if heading is None else ARROWS[round(heading / 45) % 8]
        style = f"bold {self._style_of(system_id)}"
        if vehicle is self.selected:
            style += " reverse"
        last_point = self._model.tracks[system_id][-1]
        return last_point, f"{arrow}{system_id}", style

    def _style_of(self, system_id: int) -> str:
        if system_id not in self._listed_ids:
            return ""
        return TRACK_STYLES[self._listed_ids.index(system_id) % len(TRACK_STYLES)]

    def _rates(self) -> Text:
        vehicle = self.selected
        if vehicle is None:
            return Text(UNKNOWN, "dim")
        texts = {name: _rate_text(hz) for name, hz in self._model.rates(vehicle.system_id) if hz}
        if not texts:
            return Text(UNKNOWN, "dim")
        # Sort by the displayed numbers, not by the exact rates. Names with equal numbers are in alphabetical order.
        names = sorted(texts, key=lambda name: (-float(texts[name]), name))
        lines = "\n".join(f"{texts[name]:>5} {name}" for name in names)
        return Text(lines, no_wrap=True, overflow="ellipsis")


def _rate_text(hz: float) -> str:
    # Spaces replace missing decimals, so that the decimal points are aligned.
    return f"{number(hz, 0)}  " if hz >= 3 else number(hz, 1)


def _table(rows: list[tuple[str, Text]]) -> Table:
    table = Table.grid(padding=(0, 1))
    for label, text in rows:
        table.add_row(Text(label, "dim"), text)
    return table


async def run_monitor(
    address: str | Link,
    *,
    baud: int = 57600,
    signing: Signing | None = None,
    record: str | None = None,
    on_start: Callable[[Monitor], object] | None = None,
) -> int:
    """Show the vehicles on a link until the user quits.

    Args:
        address: address of the link, or an open link. The link of an address is reopened after a loss.
        baud: baud rate of a serial port whose address does not give it.
        signing: as in :func:`aerokit.open_connection`.
        record: path of a .tlog file that records all sent and received messages.
        on_start: called with the application before it runs.

    Returns:
        The exit code: 0, or 1 after an internal error, which the application has shown.

    Raises:
        LinkOpenError: the link cannot be opened.
        AerokitError: the connection ended with this error.
    """
    async with (
        open_connection(
            address, source_system=OBSERVER_SYSTEM_ID, baud=baud, signing=signing, reconnect=isinstance(address, str)
        ) as connection,
        vehicles_on(connection) as vehicles,
    ):
        model = MonitorModel(connection, vehicles)
        commands = BackgroundTasks(connection.fail)
        app = Monitor(model, commands, str(connection.link.address))
        detach = connection.on_end(lambda error: app.exit())
        try:
            if record is not None:
                connection.record(record)
            if on_start is not None:
                on_start(app)
            await app.run_async()
            connection.raise_if_ended()
            return app.return_code or 0
        finally:
            detach()
            model.close()
            await commands.aclose()
