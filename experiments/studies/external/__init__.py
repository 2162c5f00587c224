"""A program as the model."""
