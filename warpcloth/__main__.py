"""``python -m warpcloth``, the command ``warpcloth``."""

import sys

from .cli import main

sys.exit(main())
