"""One module per command: its flags, and `main(args)`, which returns the exit code."""
