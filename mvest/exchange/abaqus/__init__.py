"""Abaqus input decks, and closures computed from them."""
