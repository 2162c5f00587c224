"""Damaged files at every importer: each must be refused in one line, soon, in little memory.

`tests.fuzz.importers` lists every importer: a function of a path, and makers of valid files. A maker
gets an empty folder, writes the files that the importer needs, and returns the one to be damaged.
`tests.fuzz.mutation` changes its bytes, words, numbers, lines, and what is compressed.

An importer fails (`tests.fuzz.trial`) if it raises anything outside `mvest.errors`, or a message of
several lines, of more than 300 characters, or without the name of a file; if this process computes
for more than 5 s or needs more than 1 GiB. Libraries work in a child whose limits are its own; how
often they were met is counted as *stopped*.

`make test` tries some inputs at each importer, and every file of ``stored/IMPORTER``: each of them
failed once. `make fuzz` tries for an hour and leaves what failed in ``outputs/fuzz`` to be stored;
``python -m tests.fuzz --seconds 60 --importer volume`` tries one importer.
"""
