"""Chordae by family: what of them is identified."""
