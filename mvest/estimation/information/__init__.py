"""What data can tell: identifiability, designs, profiles, consistency, errors of the model."""
