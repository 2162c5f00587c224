"""Learned detectors: from a volume to the valve in it, coarse to fine."""
