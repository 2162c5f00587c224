"""Jobs run: in a process apart, on this machine or on the workers of a cluster."""
