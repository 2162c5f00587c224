"""Observations of a valve, their errors, and what a model predicts of them."""
