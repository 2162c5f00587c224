"""Solid meshes of tetrahedra by fTetWild."""
