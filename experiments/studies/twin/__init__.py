"""A synthetic study: simulate, estimate, compare."""
