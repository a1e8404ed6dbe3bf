"""Studies and probes: their intervals, their overhead, whether they agree."""
