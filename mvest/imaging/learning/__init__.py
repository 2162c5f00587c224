"""How the detectors are trained and tested."""
