"""The studies: composed by Hydra, run with mvest, logged to MLflow."""
