"""``Parser``: argparse's, and what was perhaps meant when a command or an option is not known."""

from __future__ import annotations

import argparse
import re
from typing import TYPE_CHECKING, Any, NoReturn

from aerokit.wording import did_you_mean

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["Parser"]

_BELOW_ZERO = re.compile(r"-\.?\d")
_CHOICE = re.compile(r"invalid choice: '(.*)' \(choose from (.*)\)")


class Parser(argparse.ArgumentParser):
    """Its subparsers are of this class, too, and each complains of its own arguments."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        # argparse takes "-35.36,149.16,584" for an option, and half of the world is south; a number alone it knows.
        self._negative_number_matcher = _BELOW_ZERO

    def parse_known_args(  # type: ignore[override]  # typeshed has overloads for other namespaces
        self, args: Sequence[str] | None = None, namespace: Any = None
    ) -> tuple[Any, list[str]]:
        """Refuse what is left over here, where the known options and the right usage are known."""
        if args is not None and self._subparsers is None:
            self._refuse_unknown_options(args)
        namespace, unknown = super().parse_known_args(args, namespace)
        if unknown:
            self._refuse(unknown)
        return namespace, unknown

    def _refuse_unknown_options(self, args: Sequence[str]) -> None:
        """Before what stands behind one is taken for an address."""
        options = list(args[: args.index("--")] if "--" in args else args)
        names = [each.partition("=")[0] for each in options if each.startswith("--")]
        for name in names:
            if not any(known.startswith(name) for known in self._option_string_actions):
                self._refuse([name])

    def _refuse(self, unknown: Sequence[str]) -> NoReturn:
        options = [each for each in unknown if each.startswith("-")]
        meant = did_you_mean(options[0].partition("=")[0] if options else None, self._option_string_actions)
        self.error(f"unrecognized arguments: {' '.join(unknown)}{meant}")

    def error(self, message: str) -> NoReturn:
        """Exit code 2."""
        if found := _CHOICE.search(message):
            message += did_you_mean(found[1], re.findall(r"[\w.-]+", found[2]))
        super().error(message)
