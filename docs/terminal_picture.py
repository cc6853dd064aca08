"""Draws a terminal as an animated SVG, in which the lines appear one after the other.

The first frame shows all lines, for viewers without animations.
"""

from __future__ import annotations

import re
from html import escape

__all__ = ["draw_terminal"]

WIDTH, LINE_HEIGHT, LEFT, TOP = 800, 19, 18, 52
PAUSE_S, MAX_DURATION_S = 0.35, 14.0
"""Delay before a line without a time, and maximum duration of the animation, in seconds."""
STYLE = """
text { font: 13px ui-monospace, SFMono-Regular, Menlo, Consolas, monospace; fill: #d5dbe3; white-space: pre }
.message { fill: #8a96a6 } .command { fill: #ffffff } .prompt { fill: #7ee787 } .time { fill: #79c0ff }
@media (prefers-reduced-motion: no-preference) { .late { animation: hidden 1s 0.8s } }
@keyframes hidden { from, to { opacity: 0 } }
""".strip()
TIMED = re.compile(r"^ *(\d+\.\d) s .{9} ")
"""Matches seconds and height at the beginning of a line of the demonstration."""


def draw_terminal(command: str, lines: list[str]) -> str:
    """Return an SVG file in which each line appears at its time.

    Args:
        command: the command line.
        lines: its output. A line that begins with seconds (``   1.5 s …``) appears at that time.
    """
    height = TOP + LINE_HEIGHT * (len(lines) + 1)
    shapes = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height}" width="{WIDTH}" height="{height}">',
        f"<title>{escape(command)}</title><style>{STYLE}</style>",
        f'<rect width="{WIDTH}" height="{height}" rx="8" fill="#161b22"/>',
    ]
    for number, colour in enumerate(("#ff5f56", "#ffbd2e", "#27c93f")):
        shapes.append(f'<circle cx="{20 + 20 * number}" cy="18" r="6" fill="{colour}"/>')
    typed = f'<tspan class="prompt">$ </tspan><tspan class="command">{escape(command)}</tspan>'
    shapes.append(f'<text x="{LEFT}" y="{TOP}">{typed}</text>')
    for number, (line, hidden_s) in enumerate(zip(lines, appearance_times_s(lines), strict=True), 1):
        position = f'x="{LEFT}" y="{TOP + LINE_HEIGHT * number}"'
        shapes.append(
            f'<text {position} class="late" style="animation-duration:{hidden_s:.2f}s">{coloured(line)}</text>'
        )
    return "\n".join([*shapes, "</svg>\n"])


def appearance_times_s(lines: list[str]) -> list[float]:
    """Return the seconds until each line appears: its own time, but after the previous line."""
    times: list[float] = []
    now = 0.6
    for line in lines:
        timed = TIMED.match(line)
        now = max(now + PAUSE_S / 3, float(timed[1]) if timed else now + PAUSE_S)
        times.append(now)
    scale = min(1.0, MAX_DURATION_S / now)
    return [time * scale for time in times]


def coloured(line: str) -> str:
    """Colour the time and height, and indented messages of the vehicle."""
    timed = TIMED.match(line)
    if not timed:
        return escape(line)
    head, rest = line[: timed.end()], line[timed.end() :]
    message_class = ' class="message"' if rest.startswith("  ") else ""
    return f'<tspan class="time">{escape(head)}</tspan><tspan{message_class}>{escape(rest)}</tspan>'
