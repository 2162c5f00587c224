"""From image volumes to a valve."""
