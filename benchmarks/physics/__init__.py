"""Physics: what scenes cost, what they get wrong, what they survive."""
