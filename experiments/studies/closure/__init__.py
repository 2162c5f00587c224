"""A closing valve, step by step."""
