"""The valve of a reference heart: a human shape, on which everything else is synthetic."""
