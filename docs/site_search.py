"""MkDocs hook that shortens the search index of the site and ranks its entries.

The index contains the title of every section, but only the beginning of its text. The `search_boost` of a page of the
reference (`site_reference.py`) ranks its entries. Entries with an example (`reference-examples.md`) rank higher.
"""

from __future__ import annotations

import re
from functools import cache
from typing import TYPE_CHECKING, Any

from mkdocs.plugins import event_priority
from site_reference import example_names

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig

EXAMPLE_BOOST = 1.75
"""Factor for entries with an example, which users search for most."""
CLASS_BOOST = 2
"""Factor that ranks a class before its members, whose titles begin with its name."""
BREVITY_BOOST = 8
"""Weight of short titles. They rank higher, because a query matches all words that begin with it."""
STANDARD = ("reference/messages", "reference/enums")
"""Pages whose titles often differ only in the last word: ``GLOBAL_POSITION_INT``, ``GLOBAL_POSITION_INT_COV``."""
MAX_TEXT = 300
"""Maximum number of characters of a section's text."""
MAX_REFERENCE_TEXT = 90
TITLES_ONLY = ("reference/sync", "reference/fleets", "reference/enums", "reference/onboard", "about/changelog")
"""Prefixes of pages whose titles are indexed without text."""
WITHOUT_MEMBERS = (
    "reference/sim.",
    "reference/transport",
    "reference/mavlink",
    "reference/flights",
    "reference/testing",
)
"""Prefixes of pages whose classes are indexed without their members."""
COMMON_MEMBERS = (".replace", ".to_dict")
"""Members that all value classes have, which are not indexed."""
BOOST = {
    "reference/onboard": 0.4,
    "reference/external": 0.5,
    "how-to/": 2,
    "from-dronekit": 0.3,
    "coming-from/": 0.5,
    "troubleshooting": 3,
    "reliability": 0.2,
    "verification": 0.1,
    "firmware": 0.2,
    "benchmarks": 0.2,
    "design": 0.2,
    "features": 0.2,
    "examples/": 0.5,
    "about/": 0.1,
}
"""Maps the prefix of a page to the factor of its rank; the default is 1."""
CODE_BLOCK = re.compile(r"<pre>.*?</pre>", re.DOTALL)
SECTION = re.compile(r"<p>(Parameters|Raises|Returns|Yields|Attributes|Methods|Functions|Classes|Bases):.*", re.DOTALL)
CLASS_NAME = re.compile(r"[A-Z]\w+")
TAG = re.compile(r"</?(?:p|ul|ol|li|sub|sup|code|pre)>")


@event_priority(50)
def on_post_build(config: MkDocsConfig) -> None:
    """Shorten the index before the search plugin writes it."""
    index = config.plugins["material/search"].search_index  # type: ignore[attr-defined]
    index.entries = [_shortened(entry) for entry in index.entries if _is_found(entry)]


def _is_found(entry: dict[str, Any]) -> bool:
    title = TAG.sub("", entry["title"])
    page, _, anchor = entry["location"].partition("#")
    is_left_out = "." in title and page.startswith(WITHOUT_MEMBERS)
    return not anchor or not (is_left_out or title.endswith(COMMON_MEMBERS))


def _shortened(entry: dict[str, Any]) -> dict[str, Any]:
    """Return an entry with shortened text and its rank."""
    location = entry["location"]
    is_reference = location.startswith("reference/")
    text = CODE_BLOCK.sub(" ", entry["text"])
    text = " ".join(TAG.sub("", SECTION.sub("", text) if is_reference else text).split())
    limit = 0 if location.startswith(TITLES_ONLY) else MAX_REFERENCE_TEXT if is_reference else MAX_TEXT
    boost = entry.get("boost", 1) * _boost(location)
    title = TAG.sub("", entry["title"])
    if is_reference:
        boost *= (1 + BREVITY_BOOST / len(title)) ** (8 if location.startswith(STANDARD) else 1.5)
        boost *= EXAMPLE_BOOST if title in _names_with_example() else 1
        boost *= CLASS_BOOST if CLASS_NAME.fullmatch(title) else 1
    return {**entry, "title": title, "text": _cut(text, limit), "boost": round(boost, 2)}


def _boost(location: str) -> float:
    return next((boost for start, boost in BOOST.items() if location.startswith(start)), 1)


def _cut(text: str, limit: int) -> str:
    """Shorten a text to whole words within the limit."""
    return text if len(text) <= limit else text[:limit].rpartition(" ")[0]


@cache
def _names_with_example() -> frozenset[str]:
    """Return the titles of entries with an example: ``Vehicle.arm``, ``connect``, ``waypoint``."""
    return frozenset(name.rpartition(".")[2] if name[0].islower() else name for name in example_names())
