"""``python -m geokit`` is the ``geokit`` command."""

from __future__ import annotations

import sys

from geokit.cli import main

if __name__ == "__main__":
    sys.exit(main())
