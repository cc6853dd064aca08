"""Parses plans in both file formats: .plan (QGroundControl) and QGC WPL 110."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from aerokit.missions import Plan


def parse_plan_text(text: str, name: str) -> Plan:
    """Parse the text of a .plan or QGC WPL 110 file, and check the parts of the plan.

    Raises FileFormatError if the text has neither format, and InvalidArgument if an item cannot be sent to a vehicle.
    The text of a FileFormatError begins with ``name`` and the position.
    """
    from aerokit.missions import Plan, parse_plan, parse_waypoints

    bare = text.lstrip("\ufeff \t\r\n")
    is_json = bare.startswith("{") or (name.lower().endswith(".plan") and not bare.startswith("QGC WPL"))
    plan = parse_plan(text, name) if is_json else Plan(parse_waypoints(text, name))
    for part in (plan.mission, plan.fence, plan.rally):
        part.check()
    return plan
