"""Cases and results as other programs read them: one module for each kind of target.

A module NAME has ``export_NAME(source, target, options)``, which writes `target` and gives its path
back, and the frozen dataclass of its options: ``mvest export NAME SOURCE TARGET`` finds both by
these names.
"""
