"""`python -m surfkit.cli` is `surfkit`."""

import sys

from surfkit.cli import main

sys.exit(main())
