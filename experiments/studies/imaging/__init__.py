"""Training and testing of detectors for valves in volumes."""
