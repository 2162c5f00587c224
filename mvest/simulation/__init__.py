"""Simulated valves: virtual patients, and valves in motion for the image step."""
