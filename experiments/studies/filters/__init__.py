"""All filters on the same problems."""
