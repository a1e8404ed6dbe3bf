"""Learners: precision, two cores, memory, and where the time of a run goes."""
