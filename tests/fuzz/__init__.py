"""Damaged files for every importer: each must be refused in one line, soon, in little memory.

`tests.fuzz.importers` lists the importers: a function of a path, and makers of valid files. A maker
writes the files of an importer into an empty folder and returns the one to damage;
`tests.fuzz.mutation` changes its bytes, words, numbers and lines. `tests.fuzz.trial` says what
counts as a fault. Libraries work in a child with limits of its own; how often these were met is
counted as *stopped*.

`make test` tries some inputs, and every file of ``stored/IMPORTER``: each of them failed once.
`make fuzz` tries for an hour and leaves faults in ``outputs/fuzz`` to be stored;
``python -m tests.fuzz --seconds 60 --importer volume`` tries one importer.
"""
