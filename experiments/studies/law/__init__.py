"""Two material laws on the same valve."""
