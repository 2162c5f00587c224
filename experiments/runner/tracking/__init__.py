"""MLflow: its store, what is uploaded to it, and its pages."""
