"""What is seen of a valve, what a model predicts of it, and the errors of both."""
