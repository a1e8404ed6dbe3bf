"""Talk with a person at a terminal: flags, lines, a progress bar, Ctrl-C."""
