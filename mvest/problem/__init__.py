"""The joint of data, model and filter."""
