"""Detectors for valves in volumes: training and tests."""
