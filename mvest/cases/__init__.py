"""What a user brings: a valve with its frames, as a folder of data."""
