"""``python -m aerokit`` is ``aerokit``."""

import sys

from aerokit.cli import main

sys.exit(main())
