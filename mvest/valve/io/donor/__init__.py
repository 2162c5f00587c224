"""The recorded human donor valve."""
