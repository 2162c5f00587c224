"""Pictures of a valve found in images."""
