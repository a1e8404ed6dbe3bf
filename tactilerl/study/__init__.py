"""Studies: a grid of runs from a file, run on any machine, and what its runs say together."""
