"""Entry point of ``python -m aerokit``."""

import sys

from aerokit.apps.cli import main

sys.exit(main())
