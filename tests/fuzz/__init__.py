"""Damaged files at every public door: one line that says what is wrong, soon, in little memory.

`tests.fuzz.doors` is the table: for each door a function of a path, and makers of valid files. A
maker is given an empty folder, writes there what the door needs, and returns the one file that is
damaged. `tests.fuzz.mutation` changes its bytes, words, numbers, lines, and what is compressed.

A door fails (`tests.fuzz.trial`) if it raises anything outside `mvest.errors`, or a message of
several lines, of more than 300 characters, or without the name of a file; if this process computes
for more than 5 s or needs more than 1 GiB. Libraries work in a child whose limits are its own; how
often they were met is counted as *stopped*.

`make test` tries some inputs at each door, and every file of ``stored/DOOR``, which failed once.
`make fuzz` tries for an hour, or ``python -m tests.fuzz --seconds 60 --door volume``, and leaves
what failed in ``outputs/fuzz`` to be stored.
"""
