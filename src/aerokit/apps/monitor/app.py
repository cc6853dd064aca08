"""``Monitor``: the terminal application."""

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

from aerokit.apps.monitor.lines import ARROWS, UNKNOWN, Canvas, row, state_lines
from aerokit.apps.monitor.watch import Watch
from aerokit.connection.opening import ONLOOKER, no_vehicle_reason, open_connection
from aerokit.connection.tasks import Background
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

__all__ = ["Monitor", "Question", "run_monitor"]


class Question(ModalScreen[bool]):
    """Gives True for "y" or the button Yes. Enter at once is No."""

    BINDINGS: ClassVar[list[BindingType]] = [
        ("y", "answer(True)", "Yes"),
        ("n,escape,q", "answer(False)", "No"),
        ("left", "app.focus_previous", "Other"),
        ("right", "app.focus_next", "Other"),
    ]
    CSS: ClassVar[str] = """
    Question { align: center middle; }
    Question Vertical { width: 50; height: auto; border: heavy $warning; background: $surface; padding: 1 2; }
    Question Label { width: 100%; text-align: center; text-style: bold; }
    Question Horizontal { height: auto; align: center middle; margin-top: 1; }
    Question Button { margin: 0 2; }
    """

    def __init__(self, text: str) -> None:
        super().__init__()
        self.text = text
        """What is asked."""

    def compose(self) -> ComposeResult:
        """The text and two buttons, No first and focused."""
        with Vertical():
            yield Label(self.text, markup=False)
            with Horizontal():
                yield Button("No (n)", id="no")
                yield Button("Yes (y)", id="yes", variant="warning")

    def on_mount(self) -> None:
        """Enter is No."""
        self.query_one("#no").focus()

    def on_button_pressed(self, event: Button.Pressed) -> None:
        """An answer."""
        self.dismiss(event.button.id == "yes")

    def action_answer(self, yes: bool) -> None:
        """An answer by key."""
        self.dismiss(yes)


PERIOD_S = 0.25

TRACK_STYLES = ("cyan", "magenta", "yellow", "green", "blue", "red")

ORDERS = {"hold": "HOLD", "land": "LAND", "return_to_launch": "RETURN TO LAUNCH"}
"""Methods of a vehicle, and what a question calls them."""


class Monitor(App[None]):
    """Shows what a :class:`~aerokit.apps.monitor.watch.Watch` knows; orders go to the vehicle that was asked about."""

    CSS_PATH: ClassVar[str | PurePath | list[str | PurePath] | None] = "monitor.tcss"
    ENABLE_COMMAND_PALETTE: ClassVar[bool] = False
    BINDINGS: ClassVar[list[BindingType]] = [
        ("h", "order('hold')", "Hold"),
        ("l", "order('land')", "Land"),
        ("r", "order('return_to_launch')", "Return"),
        ("q", "quit", "Quit"),
        Binding("ctrl+c", "quit", "Quit", show=False, priority=True),
    ]

    def __init__(self, watch: Watch, orders: Background, name: str) -> None:
        super().__init__()
        self._watch, self._orders, self._name = watch, orders, name
        self._began_at = watch.connection.now()
        self._listed: list[int] = []

    def compose(self) -> ComposeResult:
        """Vehicles above, then state and map, then texts and rates."""
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
        """Begin to look."""
        for name, title in (("state", "state"), ("map", "map"), ("texts", "texts and events")):
            self.query_one(f"#{name}").border_title = title
        self.query_one("#rates_box").border_title = "messages a second"
        self.query_one("#texts").can_focus = False
        self.query_one("#vehicles").focus()
        self.look()
        self.set_interval(PERIOD_S, self.look)

    @property
    def selected(self) -> Vehicle | None:
        """The vehicle that the list stands on."""
        place = self.screen_stack[0].query_one("#vehicles", OptionList).highlighted
        return None if place is None else self._watch.vehicles[self._listed[place]]

    def look(self) -> None:
        """Show how things are now."""
        self._watch.look()
        base = self.screen_stack[0]
        self._list(base.query_one("#vehicles", OptionList))
        show = {"title": self._title, "state": self._state, "map": self._map, "rates": self._rates}
        for name, made in show.items():
            base.query_one(f"#{name}", Static).update(made())
        texts = base.query_one("#texts", RichLog)
        while self._watch.lines:
            texts.write(self._watch.lines.popleft())

    def on_option_list_option_highlighted(self) -> None:
        """Another vehicle was selected."""
        self.look()

    def action_order(self, method: str) -> None:
        """Ask whether the selected vehicle is to do that; the answer is about this one, whichever is selected then."""
        vehicle = self.selected
        if vehicle is None:
            self.bell()
            return

        def on_answer(yes: bool | None) -> None:
            if yes:
                self._orders.start(partial(self._give, vehicle, method))

        self.push_screen(Question(f"{ORDERS[method]}: vehicle {vehicle.system_id}?"), on_answer)

    async def _give(self, vehicle: Vehicle, method: str) -> None:
        what, note = ORDERS[method].lower(), partial(self._watch.note, vehicle.system_id)
        note(f"{what} was ordered", "bold")
        try:
            await getattr(vehicle, method)()
        except AerokitError as error:
            note(f"{what} failed: {error}", "bold red")
        else:
            note(f"{what}: done", "bold green")

    def _list(self, options: OptionList) -> None:
        vehicles = self._watch.vehicles
        for system_id in vehicles:
            if system_id not in self._listed:
                self._listed.append(system_id)
                options.add_option(Option(row(vehicles[system_id]), id=str(system_id)))
        if self._listed and options.highlighted is None:
            options.highlighted = 0
        for place, system_id in enumerate(self._listed):
            options.replace_option_prompt_at_index(place, row(vehicles[system_id]))

    def _title(self) -> Text:
        connection, count = self._watch.connection, len(self._watch.vehicles)
        state = connection.link_state.latest
        text = Text(f"{self._name}  ", "bold", no_wrap=True, overflow="ellipsis")
        text.append(f"link {state.value if state else UNKNOWN}  {count} vehicle{'s' if count != 1 else ''}")
        return text

    def _state(self) -> Table | Text:
        vehicle = self.selected
        if vehicle is None:
            waited = self._watch.connection.now() - self._began_at
            return Text(
                f"waiting for the heartbeat of a vehicle on {self._name}, for {waited:.0f} s\n\n"
                f"{no_vehicle_reason(self._watch.connection, None)}"
            )
        table = Table.grid(padding=(0, 1))
        for label, text in state_lines(vehicle):
            table.add_row(Text(label, "dim"), text)
        return table

    def _map(self) -> Text:
        watch, widget = self._watch, self.screen_stack[0].query_one("#map", Static)
        homes = [
            (home, vehicle)
            for vehicle in watch.vehicles.values()
            if (home := vehicle.home.latest) is not None and watch.tracks.get(vehicle.system_id)
        ]
        marks = [
            (watch.metres(home.latitude_deg, home.longitude_deg), "H", "bold green") for home, _ in homes
        ]
        points = [point for track in watch.tracks.values() for point in track] + [mark[0] for mark in marks]
        if not points:
            return Text("no position is known", "dim")
        canvas = Canvas(widget.content_size.width, widget.content_size.height, points)
        for system_id, track in watch.tracks.items():
            for point in track:
                canvas.dot(point, self._style_of(system_id))
        for mark in [*marks, *map(self._mark_of, watch.tracks)]:
            canvas.mark(*mark)
        widget.border_subtitle = f"{canvas.width_m:.0f} m wide, north up"
        return canvas.text()

    def _mark_of(self, system_id: int) -> tuple[tuple[float, float], str, str]:
        vehicle = self._watch.vehicles[system_id]
        heading = vehicle.heading_deg.latest
        arrow = "?" if heading is None else ARROWS[round(heading / 45) % 8]
        style = f"bold {self._style_of(system_id)}" + (" reverse" if vehicle is self.selected else "")
        return self._watch.tracks[system_id][-1], f"{arrow}{system_id}", style

    def _style_of(self, system_id: int) -> str:
        return (
            TRACK_STYLES[self._listed.index(system_id) % len(TRACK_STYLES)]
            if system_id in self._listed
            else ""
        )

    def _rates(self) -> Text:
        vehicle = self.selected
        if vehicle is None:
            return Text(UNKNOWN, "dim")
        lines = [Text(f"{hz:5.1f} {name}") for name, hz in self._watch.rates(vehicle.system_id)]
        return Text("\n", no_wrap=True, overflow="ellipsis").join(lines) if lines else Text(UNKNOWN, "dim")


async def run_monitor(
    address: str | Link,
    *,
    baud: int = 57600,
    signing: Signing | None = None,
    show: Callable[[Monitor], object] | None = None,
) -> int:
    """Show the vehicles on a link until the user leaves.

    Args:
        address: of the link; a lost one is opened again.
        baud: of a serial port whose address says none.
        signing: as of :func:`aerokit.open_connection`.
        show: called with the application before it runs.

    Returns:
        Exit code: 0, or 1 after a mistake in the application, which it has shown.

    Raises:
        LinkOpenError: the link cannot be opened; the terminal was not touched.
        AerokitError: what ended the connection meanwhile.
    """
    async with (
        open_connection(
            address,
            source_system=ONLOOKER,
            baud=baud,
            signing=signing,
            reconnect=isinstance(address, str),
        ) as link,
        vehicles_on(link) as vehicles,
    ):
        watch, orders = Watch(link, vehicles), Background(link.fail)
        app = Monitor(watch, orders, str(link.link.address))
        detach = link.on_end(lambda error: app.exit())
        try:
            if show is not None:
                show(app)
            await app.run_async()
            link.raise_if_ended()
            return app.return_code or 0
        finally:
            detach()
            watch.close()
            await orders.aclose()
