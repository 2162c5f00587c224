"""A collected sweep, and its tables and figures."""
