"""What jobs have ended with, in files: of a sweep, of all estimates, and of what made what."""
