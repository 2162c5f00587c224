"""Exporters of cases and results, one module per target.

A module NAME defines ``export_NAME(source, target, options)``, which writes `target` and returns
its path, and a frozen options dataclass. ``mvest export NAME`` finds both by name.
"""
