"""``python -m sb3_flock.cli``."""

import sys

from sb3_flock.cli import main

sys.exit(main())
