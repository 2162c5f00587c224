"""Files of surfaces and solid meshes, and the recorded donor valve."""
