"""What other programs write, as cases: one module for each kind of source.

A module NAME has ``import_NAME(source, options)``, which makes a `mvest.cases.case.ValveCase`, and
the frozen dataclass of its options: ``mvest import NAME SOURCE CASE`` finds both by these names.
"""
