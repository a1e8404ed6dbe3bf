"""Talk with a person at a terminal: flags, lines, how far long work is."""
