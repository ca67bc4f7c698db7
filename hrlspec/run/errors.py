"""What a command line says and returns when it cannot go on.

Exit status 0: done; 1: failed, as training that diverged, or results that could not be printed; 2: bad usage or input;
130: interrupted. Each but the first comes with one clear line on standard error. Anything else is a bug and shows its
traceback.
"""

from __future__ import annotations

import errno
import os
import sys
from collections.abc import Callable

from hrlspec.run.signals import INTERRUPTED, ended_by_signals
from hrlspec.run.streams import lasting_streams

OK, FAILED, BAD_INPUT = 0, 1, 2
_REFUSED = {
    getattr(errno, name)
    for name in ("EACCES", "EDQUOT", "EFBIG", "EIO", "ENAMETOOLONG", "ENOSPC", "EPERM", "EROFS", "ESTALE")
}


class UserError(Exception):
    """Something the user can mend. The message says what was found, what was expected and what to do."""


class Interrupted(Exception):
    """The work stopped on request, in order. The message says what was saved and how to go on."""


def main_guard(main: Callable[[], None]) -> int:
    """Runs a command line and returns its exit status: ``sys.exit(main_guard(main))``.

    `UserError`, `SpecError`, `SuiteError`, `CheckpointError` and `AgentFileError` become one line on standard error and
    status 2; `Interrupted` becomes one and status 130. Where the work does not stop in order, Ctrl-C and SIGTERM end
    the process with status 130. What the system refuses, such as room on a disk that is full, becomes one line and
    status 1. ``SystemExit``, which the parser of flags raises, passes through.

    Nothing that cannot be written stops the work. If it was a result it is said at the end, with status 1; a reader
    who left, as in ``... | head``, has what it wants.
    """
    with lasting_streams() as out, ended_by_signals():
        try:
            main()
        except Interrupted as stop:
            return _say(f"interrupted: {stop}", INTERRUPTED)
        except Exception as error:
            if isinstance(error, OSError) and error.errno in _REFUSED:
                place = f"{os.fsdecode(error.filename)}: " if error.filename else ""
                return _say(f"error: {place}{error.strerror}", FAILED)
            if not isinstance(error, _expected()):
                raise
            return _say(f"error: {error}", BAD_INPUT)
        finally:
            out.flush()
        if out.lost is not None and out.lost.errno != errno.EPIPE:
            return _say(f"error: cannot write to standard output: {out.lost.strerror}", FAILED)
    return OK


def in_words(error: Exception) -> str:
    """Whatever somebody else's code raised, on one line, of which there is not much."""
    said = " ".join(str(error).split())
    return f"{type(error).__name__}: {said[:200] or 'without a message'}"


def _expected() -> tuple[type[Exception], ...]:
    """What the user can mend. Imported when needed: these modules take seconds, and signals come meanwhile."""
    from hrlspec.agent_files import AgentFileError
    from hrlspec.checkpoint import CheckpointError
    from hrlspec.presets.suites import SuiteError
    from hrlspec.spec import SpecError

    return UserError, SpecError, SuiteError, CheckpointError, AgentFileError


def _say(line: str, status: int) -> int:
    """Prints the message as one line, whatever it holds."""
    print(" ".join(line.split()), file=sys.stderr, flush=True)
    return status
