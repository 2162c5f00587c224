"""Reading volumes over time from the files that scanners and viewers write."""
