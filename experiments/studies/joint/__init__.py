"""Chordal length and moduli from a whole cycle."""
