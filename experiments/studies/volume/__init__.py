"""A volume over time to moduli with intervals."""
