"""Lets ``python -m warpcloth`` run the command ``warpcloth``."""

import sys

from .cli import main

sys.exit(main())
