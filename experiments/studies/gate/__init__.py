"""The gate: whether the closed valve is one state."""
