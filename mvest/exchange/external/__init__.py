"""A biomechanical model that is an external program (contract: README.md beside this file)."""
