"""Words for errors: values as text whatever they are, and names that were perhaps meant."""

from __future__ import annotations

from collections.abc import Iterable

_LONGEST = 100


def shown(value: object) -> str:
    """``repr`` of a value; cut short when it is long, its type when it has none (an int of 5000 digits has not)."""
    try:
        text = repr(value)
    except Exception:  # whatever a stranger's class does
        text = f"<{type(value).__name__}>"
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 3]}..."


def in_words(value: object) -> str:
    """A value of an event for people: the name of an enumeration's member, three digits or so of a number."""
    if isinstance(value, float):
        return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}"
    name = getattr(value, "name", None)
    return name if isinstance(name, str) else str(value)


def one(kind: str) -> str:
    """``a Position``, ``an AttitudeSetpoint``."""
    return f"{'an' if kind[:1] in 'AEIO' else 'a'} {kind}"


def did_you_mean(name: object, known: Iterable[str]) -> str:
    """``" (did you mean 'GUIDED'?)"``, in whatever case the name is written; nothing when no known name is like it."""
    if not isinstance(name, str) or len(name) > _LONGEST:
        return ""
    import difflib  # only now: it is needed for such texts alone

    by_capitals = {each.upper(): each for each in known}
    close = difflib.get_close_matches(name.upper(), by_capitals, n=1)
    return f" (did you mean {by_capitals[close[0]]!r}?)" if close else ""
