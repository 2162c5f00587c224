"""What the frames of a cycle tell, and a modulus that drifts over beats."""
