"""What a job is: its configuration, its folder, its limits, and what it ended with."""
