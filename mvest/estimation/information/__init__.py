"""Identifiability, designs of observations, and consistency of estimates."""
