"""Solid meshes of leaflets: layers, tetrahedra, quality, material points."""
