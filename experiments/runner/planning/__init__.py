"""What a sweep will run: its jobs, composed, with those that are done and the time they take."""
