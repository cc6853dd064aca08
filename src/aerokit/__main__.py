"""``python -m aerokit`` is ``aerokit``."""

import sys

from aerokit.apps.cli import main

sys.exit(main())
