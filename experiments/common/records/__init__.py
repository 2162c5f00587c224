"""What a study finds, as it is written down, and the tables and words that are made of it."""
