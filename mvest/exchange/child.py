"""A child process with bounded memory and time that reads the files of users.

On damaged bytes, libraries may allocate whatever a header claims, loop, or crash. Such a file ends
the child, and the caller gets a one-line error. One child serves all files of a process; it starts
with the first file, and again after a crash.

Starting takes 0.3 s, a call 1 ms, and passing 100 MB of arrays 0.1 s.
"""

import atexit
import importlib
import json
import os
import resource
import struct
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from subprocess import PIPE
from typing import Any, BinaryIO

import numpy as np

from mvest import errors
from mvest.errors import InputError, MvestError
from mvest.processes import Program, ending, environment, python
from mvest.provenance import THREAD_VARIABLES
from mvest.reading.text import MAX_LINE, one_line

MEMORY_GB, SECONDS = 3.0, 60.0
"""Limits of a call: GiB of address space beyond the bare process; s."""

_lock = threading.Lock()
_child: Program | None = None
_owner = 0


def in_child(
    function: Callable[..., Any],
    path: Path,
    *arguments: Any,
    memory_gb: float = MEMORY_GB,
    seconds: float = SECONDS,
) -> Any:
    """Compute ``function(path, *arguments)`` in the child, within limits.

    The function is defined at module level. It returns a tree of dict (with str keys), list, str,
    int, float, bool, None and numeric NumPy arrays; tuples become lists. Arguments must fit JSON.

    MvestError as raised by the function. An `InputError`, one line that names the file, if the file
    is missing, the function raised anything else, or the child exceeded a limit or crashed.
    """
    global _child, _owner
    if not path.is_file():
        raise InputError(f"{path}: {'a folder' if path.is_dir() else 'no such file'}")
    call = {
        "function": [function.__module__, function.__name__],
        "arguments": [str(path.resolve()), *arguments],
        "memory_gb": memory_gb,
        "seconds": seconds,
    }
    with _lock:
        if _child is None or _owner != os.getpid() or _child.process.poll() is not None:
            alone = environment(**dict.fromkeys(THREAD_VARIABLES, "1"))
            _child = Program(python(__name__), env=alone, stdin=PIPE, stdout=PIPE)
            _owner = os.getpid()
        program = _child
        late = threading.Event()

        def expire() -> None:
            late.set()
            program.end()

        timer = threading.Timer(seconds, expire)
        timer.daemon = True
        timer.start()
        try:
            _write(program.process.stdin, call)
            answer = _read(program.process.stdout)
        except BaseException as error:
            _child = None
            program.close()
            if not isinstance(error, OSError | EOFError):
                raise
            code: int = program.process.returncode
            how = f"more than {seconds:g} s" if late.is_set() else ending(code)
            raise InputError(
                f"{path}: damaged, or too large: its reader stopped: {how} (limits "
                f"{memory_gb:g} GiB, {seconds:g} s)"
            ) from error
        finally:
            timer.cancel()
            timer.join()
        if late.is_set():  # the time limit passed just after the answer
            _child = None
            program.close()
    if "error" in answer:
        words = answer["message"].removeprefix(f"{path.resolve()}: ")
        kind: type[MvestError] = getattr(errors, answer["error"])
        raise kind(f"{path}: {one_line(words, MAX_LINE - len(path.name) - 2)}")
    return answer["result"]


@atexit.register
def _close() -> None:
    if _child is not None and _owner == os.getpid():
        _child.close()


def _write(stream: Any, tree: Any) -> None:
    """Write a tree: the length of its JSON, the JSON, then the bytes of its arrays."""
    arrays: list[np.ndarray] = []

    def plain(value: Any) -> Any:
        if isinstance(value, np.generic):
            return value.item()
        arrays.append(np.ascontiguousarray(value))
        return {"__array__": [arrays[-1].dtype.str, arrays[-1].shape]}

    text = json.dumps(tree, default=plain).encode()
    stream.write(struct.pack("<q", len(text)) + text)
    for array in arrays:
        stream.write(array.reshape(-1).view(np.uint8).data)
    stream.flush()


def _read(stream: Any) -> Any:
    """Read a tree written by `_write`. EOFError if the stream ended."""

    def exactly(size: int) -> np.ndarray:
        content = np.empty(size, dtype=np.uint8)
        # A buffered stream fills the array unless it ended.
        if stream.readinto(content.data) < size:
            raise EOFError
        return content

    def whole(value: dict[str, Any]) -> Any:
        if list(value) != ["__array__"]:
            return value
        dtype, shape = np.dtype(value["__array__"][0]), tuple(value["__array__"][1])
        size = int(np.prod(shape, dtype=np.int64)) * dtype.itemsize
        return exactly(size).view(dtype).reshape(shape)

    (size,) = struct.unpack("<q", exactly(8).tobytes())
    # The parser completes JSON objects in the order of their ends, the order of the array bytes.
    return json.loads(exactly(size).tobytes(), object_hook=whole)


def main() -> None:
    """Answer calls until the input closes."""
    requests: BinaryIO = os.fdopen(os.dup(0), "rb")
    answers: BinaryIO = os.fdopen(os.dup(1), "wb")
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    nothing = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):  # libraries print messages
        os.dup2(nothing, stream)
    with suppress(EOFError, KeyboardInterrupt):
        while True:
            _write(answers, _answered(_read(requests)))


def _answered(call: dict[str, Any]) -> dict[str, Any]:
    module, name = call["function"]
    path, *arguments = call["arguments"]
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    try:
        function = getattr(importlib.import_module(module), name)
        amount = _size() + int(call["memory_gb"] * 2**30)
        least = min(n for n in (amount, soft, hard) if n != resource.RLIM_INFINITY)
        resource.setrlimit(resource.RLIMIT_AS, (least, hard))
        return {"result": function(Path(path), *arguments)}
    except MvestError as error:
        return {"error": type(error).__name__, "message": str(error)}
    except ImportError as error:
        reason = f"{error}; pip install 'mvest[files]' has it"
        return {"error": "ConfigurationError", "message": reason}
    except MemoryError:
        reason = f"reading it needs more than {call['memory_gb']:g} GiB"
        return {"error": "InputError", "message": reason}
    except Exception as error:  # libraries fail in many ways on a damaged file
        return {"error": "InputError", "message": f"damaged: {str(error) or type(error).__name__}"}
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def _size() -> int:
    """Address space of this process (bytes); 2 GiB if the system does not report it."""
    try:
        pages = Path("/proc/self/statm").read_text(encoding="ascii").split()[0]
    except OSError:
        return 2**31
    return int(pages) * os.sysconf("SC_PAGE_SIZE")


if __name__ == "__main__":
    main()
