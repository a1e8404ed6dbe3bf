"""Learners: which choices matter, and a second core."""
