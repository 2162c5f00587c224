"""Importers that make cases from other programs' files, one module per source.

A module NAME defines ``import_NAME(source, options)``, which makes a `mvest.cases.case.ValveCase`,
and a frozen options dataclass. ``mvest import NAME`` finds both by name.
"""
