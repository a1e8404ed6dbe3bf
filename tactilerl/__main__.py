"""The program: first of all what Ctrl-C does, then everything else."""

import sys

from . import interrupts

interrupts.leave_at_once()

from .cli import main  # noqa: E402

if __name__ == "__main__":
    sys.exit(main())
