"""The program: first of all what Ctrl-C does, then everything else."""

import sys

from .errors import leave_at_once

leave_at_once()

from .commands.cli import main  # noqa: E402

if __name__ == "__main__":
    sys.exit(main())
