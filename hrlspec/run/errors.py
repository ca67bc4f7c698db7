"""What a command line says and returns when it cannot go on.

Exit status 0: done; 2: bad usage or input, with one clear line on standard error and no traceback; 130: interrupted.
Anything else is a bug and shows its traceback.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable
from types import FrameType

from hrlspec.checkpoint import CheckpointError
from hrlspec.presets.suites import SuiteError
from hrlspec.spec import SpecError

OK, BAD_INPUT, INTERRUPTED = 0, 2, 130


class UserError(Exception):
    """Something the user can mend. The message says what was found, what was expected and what to do."""


class Interrupted(Exception):
    """The work stopped on request, in order. The message says what was saved and how to go on."""


def main_guard(main: Callable[[], None]) -> int:
    """Runs a command line and returns its exit status: ``sys.exit(main_guard(main))``.

    `UserError`, `SpecError`, `SuiteError` and `CheckpointError` become one line on standard error and status 2.
    `Interrupted`, Ctrl-C and SIGTERM become status 130. ``SystemExit``, which the parser of flags raises, passes
    through.
    """
    # Without this SIGTERM would end the process on the spot: no lock released in order, no status of its own.
    in_main_thread = threading.current_thread() is threading.main_thread()
    before = signal.signal(signal.SIGTERM, _interrupt) if in_main_thread else None
    try:
        main()
        sys.stdout.flush()
    except (UserError, SpecError, SuiteError, CheckpointError) as error:
        return _say(f"error: {error}", BAD_INPUT)
    except Interrupted as stop:
        return _say(f"interrupted: {stop}", INTERRUPTED)
    except KeyboardInterrupt:
        return _say("interrupted", INTERRUPTED)
    except BrokenPipeError:
        # The reader has left, as in `... | head`. What is still buffered must not raise again at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return OK
    finally:
        if before is not None:
            signal.signal(signal.SIGTERM, before)
    return OK


def _interrupt(number: int, frame: FrameType | None) -> None:
    del number, frame
    raise KeyboardInterrupt


def _say(line: str, status: int) -> int:
    """Prints the message as one line, whatever it holds."""
    print(" ".join(line.split()), file=sys.stderr, flush=True)
    return status
