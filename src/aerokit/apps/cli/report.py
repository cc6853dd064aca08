"""``aerokit report``: a flight log, or two compared, as one HTML file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from aerokit.apps.cli.output import DONE, add_json, need, tell
from aerokit.apps.cli.terminal import progress_bar
from aerokit.logs.report.figures import clock

if TYPE_CHECKING:
    import argparse

    from aerokit.logs.report import Report


def add_arguments(command: argparse.ArgumentParser) -> None:
    """The arguments of the command."""
    command.set_defaults(run=_report)
    command.add_argument("log", type=Path, metavar="LOG", help=".tlog, .bin (ArduPilot) or .ulg (PX4)")
    command.add_argument("other", type=Path, nargs="?", metavar="LOG2", help="another log: both are compared")
    command.add_argument(
        "-o", "--output", type=Path, metavar="OUT.html", help="the file (the name of the log, with .html)"
    )
    command.add_argument(
        "--system",
        type=int,
        metavar="ID",
        help="whose flight, where a .tlog has several vehicles (the first)",
    )
    command.add_argument("--force", action="store_true", help="replace a file that is there already")
    command.add_argument("--open", action="store_true", help="open it in the browser")
    add_json(command)


async def _report(options: argparse.Namespace) -> int:
    need("plotly", "report")
    logs = [options.log] if options.other is None else [options.log, options.other]
    if any(log.suffix.lower() == ".ulg" for log in logs):
        need("pyulog", "report")
    from aerokit.logs.report import write_report

    target = options.output or options.log.with_suffix(".html")
    with progress_bar(options.log.name, "B") as on_progress:
        made = write_report(
            options.log,
            target,
            compare_with=options.other,
            system_id=options.system,
            force=options.force,
            on_progress=on_progress,
        )
    tell(options, "report", {**made.to_dict(), "logs": logs}, _text(made))
    if options.open:
        import webbrowser

        webbrowser.open(made.target.resolve().as_uri())
    return DONE


def _text(made: Report) -> str:
    lines = []
    for number, (sentences, failsafes) in enumerate(zip(made.summaries, made.failsafes, strict=True)):
        if len(made.summaries) > 1:
            lines.append(f"{'AB'[number]}:")
        lines += sentences
        for each in failsafes:
            lines.append(f"{clock(each.time_s)} {each.title}: {each.reaction}")
            lines += [f"  {fact}" for fact in each.led_to]
    return "\n".join([*lines, f"{made.target}: {made.bytes / 1e6:.1f} MB"])
