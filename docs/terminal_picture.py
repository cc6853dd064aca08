"""A terminal as an SVG picture: whole at first, then the lines appear one after the other.

What shows no animations, or only the first moment of them, shows all of it.
"""

from __future__ import annotations

import re
from html import escape

__all__ = ["draw_terminal"]

WIDTH, LINE_HEIGHT, LEFT, TOP = 800, 19, 18, 52
PAUSE_S, LONGEST_S = 0.35, 14.0
"""Before each line, where none of them tells its time; all of it takes this long at most."""
STYLE = """
text { font: 13px ui-monospace, SFMono-Regular, Menlo, Consolas, monospace; fill: #d5dbe3; white-space: pre }
.said { fill: #8a96a6 } .command { fill: #ffffff } .prompt { fill: #7ee787 } .time { fill: #79c0ff }
@media (prefers-reduced-motion: no-preference) { .late { animation: hidden 1s 0.8s } }
@keyframes hidden { from, to { opacity: 0 } }
""".strip()
TIMED = re.compile(r"^ *(\d+\.\d) s .{9} ")
"""Seconds and height, as the demonstration begins a line."""


def draw_terminal(command: str, lines: list[str]) -> str:
    """The text of an SVG file; each line is hidden for as long as it took to come.

    Args:
        command: what was typed.
        lines: what was printed; those that begin with seconds (``   1.5 s …``) appear in that rhythm.
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
    for number, (line, hidden_s) in enumerate(zip(lines, hidden_for_s(lines), strict=True), 1):
        place = f'x="{LEFT}" y="{TOP + LINE_HEIGHT * number}"'
        shapes.append(
            f'<text {place} class="late" style="animation-duration:{hidden_s:.2f}s">{coloured(line)}</text>'
        )
    return "\n".join([*shapes, "</svg>\n"])


def hidden_for_s(lines: list[str]) -> list[float]:
    """Until each line appears: by its own seconds where it has some, a moment after the one before at least."""
    times: list[float] = []
    now = 0.6
    for line in lines:
        timed = TIMED.match(line)
        now = max(now + PAUSE_S / 3, float(timed[1]) if timed else now + PAUSE_S)
        times.append(now)
    scale = min(1.0, LONGEST_S / now)
    return [time * scale for time in times]


def coloured(line: str) -> str:
    """Seconds and height in one colour, what the vehicle said in another."""
    timed = TIMED.match(line)
    if not timed:
        return escape(line)
    head, rest = line[: timed.end()], line[timed.end() :]
    said = ' class="said"' if rest.startswith("  ") else ""
    return f'<tspan class="time">{escape(head)}</tspan><tspan{said}>{escape(rest)}</tspan>'
