"""One leaflet-like sheet in two finite-element codes: a second model for the filters, by example.

``sheet`` says what the sheet is; ``own`` predicts it with this project's mechanics, ``second`` with
scikit-fem (an optional extra); ``solver`` is ``second`` as a program that is asked through files,
by the contract of :mod:`mvest.external`. The two codes share nothing but the numbers in ``sheet``:
element, strains, load, tangent and derivatives are written twice, from different formulas.
"""
