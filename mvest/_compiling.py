"""Where numba caches compiled kernels, and a note when it compiles."""

import os
import stat
import sys
from contextlib import suppress
from pathlib import Path

VARIABLE = "NUMBA_CACHE_DIR"
"""Environment variable that names the folder."""

KIND = "numba:compile"
"""What numba calls the event; a kernel that is loaded from the cache causes none."""

NOTE = "compiling numerical kernels; this takes up to a minute, once after an installation"
"""Line of `announce_compilation`."""


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


def announce_compilation() -> None:
    """Say in one line when numba first compiles something in this process: it takes a while."""
    from numba.core import event

    class Announcement(event.Listener):
        def on_start(self, _: object) -> None:
            event.unregister(KIND, self)  # type: ignore[no-untyped-call]
            print(NOTE, file=sys.stderr, flush=True)

        def on_end(self, _: object) -> None:
            pass

    event.register(KIND, Announcement())  # type: ignore[no-untyped-call]
