"""What is fast, what is right, and what it costs: figures for the docs, never asserted on time."""
