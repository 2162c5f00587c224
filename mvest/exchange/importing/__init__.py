"""Importers of cases from the files of other programs, one module per source.

A module NAME has ``import_NAME(source, options)``, which makes a `mvest.cases.case.ValveCase`, and
the frozen dataclass of its options. ``mvest import NAME`` finds both by these names.
"""
