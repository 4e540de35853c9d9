"""The terminal's side of every command: errors become one sentence and an exit code.

Commands are thin: parse, build, call, print. `run` is the one place where an error turns into text.
"""

from __future__ import annotations

import errno
import os
import sys
from collections.abc import Callable

from drivers.errors import EXIT_INTERRUPTED, CropError, StorageError

EXIT_CODES = (
    "Exit codes: 0 done; 2 something given cannot be used; 3 a device failed; 4 the data are not good enough; "
    "5 the disk is full or read-only; 130 interrupted."
)


def say_error(message: str) -> None:
    """Print one error line to stderr."""
    print(f"error: {message}", file=sys.stderr)


def run(command: Callable[[], object]) -> int:
    """Call `command` and return the exit code; a foreseeable fault is one line on stderr, no traceback."""
    try:
        command()
    except CropError as error:
        say_error(str(error))
        return error.exit_code
    except KeyboardInterrupt:
        say_error("interrupted; run the same command again to go on")
        return EXIT_INTERRUPTED
    except BrokenPipeError:
        # The reader of our output left (head, a closed pager): not a fault, but nothing more can be printed.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EROFS, errno.EDQUOT):
            say_error(f"cannot write {error.filename or 'to the disk'}: {error.strerror}; free space and run again")
            return StorageError.exit_code
        raise
    except SystemExit as error:
        return error.code if isinstance(error.code, int) else int(error.code is not None)
    return 0
