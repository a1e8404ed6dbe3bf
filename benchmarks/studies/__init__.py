"""Studies: what they found, and what scripted hands say before them."""
