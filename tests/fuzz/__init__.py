"""Damaged files for every reader: one line that says what is wrong, soon, and in little memory.

A reader is entered in the table of one of the modules that `tests.fuzz.readers` joins, by its name,
a function of a path, and makers of valid examples, written by other code than the reader's own
where there is any::

    Reader("volume.nifti", lambda path: read_volume(path, modality=Modality.MR), (nifti, nifti_gz))

A maker is given an empty folder, writes there whatever the reader needs, and returns the one file
that is damaged::

    def nifti(folder: Path) -> Path:
        nibabel.save(image(), folder / "a.nii")
        return folder / "a.nii"

A reader of a folder is a function of one of its files (``lambda path: read_case(path.parent)``),
with a maker for each of the files. Files are small, some kB: what is changed should be met.

`tests.fuzz.mutation` changes bytes, words, numbers, lines, and what is compressed inside
(gzip, zip, npz). `tests.fuzz.child` reads in a process of its own, and says how it ended. A reader
fails where it raises anything outside `mvest.errors`, a message of several lines, of more than 300
characters or without the file's name, where it computes for more than 5 s, or asks for more than
1 GiB. `test_readers` tries some inputs of each within `make test`, and every file of the folder
``stored``, whose inputs failed once: ``stored/READER/NAME.SUFFIX``, named as the maker names it but
for what stands before the first dot. `make fuzz` tries for an hour, or ``python -m tests.fuzz
--seconds 60 --reader volume.nifti``, and leaves what failed in ``outputs/fuzz`` to be stored.
"""
