"""One's own valve: a folder of data to moduli with intervals."""
