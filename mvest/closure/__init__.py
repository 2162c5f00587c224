"""Combines valve and mechanics: parameters in, the moving and the closed valve out."""
