"""Input decks of Abaqus, and closures that were computed from them."""
