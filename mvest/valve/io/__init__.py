"""Files of surfaces and solid meshes, and recorded closures."""
