"""A stiff patch of a leaflet."""
