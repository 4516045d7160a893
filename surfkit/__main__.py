"""`python -m surfkit`: the command, where it is not on the PATH."""

import sys

from surfkit.cli import main

sys.exit(main())
