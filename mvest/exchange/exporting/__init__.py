"""Exporters of cases and results, one module per target.

A module NAME has ``export_NAME(source, target, options)``, which writes `target` and returns its
path, and the frozen dataclass of its options. ``mvest export NAME`` finds both by these names.
"""
