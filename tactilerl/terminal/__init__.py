"""What commands say to a person and hear from one: flags, lines, a progress bar, Ctrl-C."""
