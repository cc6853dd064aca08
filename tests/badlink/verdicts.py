"""Verdict on one transfer: exact or an honest error, bounded, nothing left, and its time relative to the ideal."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from bad_link import Program, Radio, attempt
from transfers_under_test import Case, Sizes, leftovers, make_copter, names_what_is_missing

from aerokit.errors import AerokitError


@dataclass(frozen=True)
class Verdict:
    """Result of one transfer."""

    case: str
    seed: int
    error: AerokitError | None
    """None: the content is exact."""
    seconds: float
    ratio: float
    """Time relative to the ideal."""
    messages: int
    faults: list[str] = field(default_factory=list)
    """Violations."""

    @property
    def is_exact(self) -> bool:
        """Return True if the content is complete and there are no faults."""
        return self.error is None and not self.faults


def judge(case: Case, sizes: Sizes, radio: Radio, seed: int) -> Verdict:
    """Do a transfer once and look at all that is promised of it."""
    copter = make_copter(case, sizes, radio)
    # The ideal is computed first, because reading files changes the server's state.
    ideal_s, most = (
        case.ideal(copter, sizes).seconds(radio),
        case.most_messages(copter, sizes, link_dies=radio.outage_s == math.inf),
    )

    async def work(program: Program) -> object:
        return await case.work(program, sizes)

    done = attempt(work, radio, seed, lambda: copter, before=case.before, leftovers=leftovers)
    faults = [f"left: {name}" for name in done.left]
    if done.messages > most:
        faults.append(f"{done.messages} messages, at most {most} are allowed: {dict(done.sent)}")
    error = done.error
    if error is None:
        try:
            case.check(done.value, copter, sizes)
        except AerokitError as result:  # of one of many
            error = result
        except AssertionError as difference:
            faults.append(f"wrong content: {difference}"[:300])
    if error is not None and not names_what_is_missing(error):
        faults.append(f"the error does not say what is missing: {error!r}")
    return Verdict(
        case.name,
        seed,
        error if isinstance(error, AerokitError) else None,
        done.seconds,
        done.seconds / ideal_s,
        done.messages,
        faults,
    )
