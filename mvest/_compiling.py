"""The folder of numba's cache."""

import os
import stat
from contextlib import suppress
from pathlib import Path

VARIABLE = "NUMBA_CACHE_DIR"
"""Environment variable that names the folder."""


def choose_cache() -> None:
    """Give numba a cache folder if it can write to none of its own.

    numba tries `VARIABLE`, the folder of the code, and the user's cache, and fails if all are
    read-only, as in a container. It executes what it finds there, so the replacement is a temporary
    folder that only this user can write to.
    """
    cache = os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser()
    given = os.environ.get(VARIABLE) or os.devnull
    places = Path(given), Path(__file__).with_name("__pycache__"), Path(cache, "numba")
    if not any(map(_writable, places)):
        with suppress(OSError):
            os.environ[VARIABLE] = str(_private_folder())


def _writable(folder: Path) -> bool:
    """Whether files can be created in a folder, which need not exist yet."""
    while not folder.exists():
        folder = folder.parent
    return folder.is_dir() and os.access(folder, os.W_OK | os.X_OK)


def _private_folder() -> Path:
    import tempfile  # slow to import, and seldom needed

    folder = Path(tempfile.gettempdir()) / f"mvest-numba-{os.getuid()}"
    with suppress(FileExistsError):
        folder.mkdir(mode=0o700)
    found = folder.lstat()
    private = stat.S_ISDIR(found.st_mode) and not found.st_mode & 0o077
    if private and found.st_uid == os.getuid():
        return folder
    return Path(tempfile.mkdtemp(prefix="mvest-numba-"))
