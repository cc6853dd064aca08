"""The question before an order: it names the vehicle and the order, and anything but a clear yes is no."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from textual.containers import Horizontal, Vertical
from textual.screen import ModalScreen
from textual.widgets import Button, Label

if TYPE_CHECKING:
    from textual.app import ComposeResult
    from textual.binding import BindingType

__all__ = ["Question"]


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
