"""A biomechanical model that is an external program (contract: README.md in this folder)."""
