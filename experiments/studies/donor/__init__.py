"""The recorded donor valve."""
