"""One room a study."""
