"""Virtual patients in simulated volumes."""
