"""Geometry of triangulated surfaces: distances, intersections, thickening, material coordinates."""
