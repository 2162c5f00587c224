"""One sheet in two finite-element codes."""
