"""How every command line of this repository ends: well, or with one sentence on stderr and code 2, never with a traceback.

with command_line("pg.py"):
    train(tyro.cli(Args))
"""

import contextlib
import os
import re
import sys

from envs.base import UsageError

# What numpy and torch say, beside a MemoryError, of something that does not fit into memory.
TOO_LARGE = ("array is too big", "Maximum allowed dimension", "can't allocate memory", "Storage size calculation overflowed")


@contextlib.contextmanager
def command_line(name):
    """Run the block as the command line `name`: all that the outside world may do to it ends in a sentence and an exit code.

    2: what was asked for is impossible, does not fit into memory, or a file or stream cannot be used; 130: Ctrl-C;
    141: nobody reads the output any more, as in `| head`. What is written to a stderr that takes nothing is lost.
    """
    with usable_streams():
        try:
            try:
                yield
            finally:
                sys.stdout.flush()  # or a full disk would show only after all this, as a complaint of Python's
        except BrokenPipeError:
            silence(sys.stdout)
            sys.exit(141)
        except KeyboardInterrupt:
            sys.exit(130)
        except Exception as error:
            if not (sentence := sentence_of(error)):
                raise
            silence(sys.stdout, unless_it_works=True)
            print(f"{name}: {sentence}", file=sys.stderr)
            sys.exit(2)


def sentence_of(error):
    """What is to be said of an exception that is no fault of the program; empty if it is one."""
    if isinstance(error, UsageError):
        return str(error)
    if isinstance(error, OSError):
        return f"cannot use {error.filename or 'standard output'}: {error.strerror or one_line(error)}."
    if isinstance(error, MemoryError | OverflowError) or any(words in str(error) for words in TOO_LARGE):
        return f"this is too large for the machine ({one_line(error)})."
    return ""


def one_line(error):
    """What an exception says, in one line without a full stop."""
    said = " ".join(str(error).split()).rstrip(".").replace(". ", "; ")
    return re.sub(r"(\d); ", r"\1 ", said) or type(error).__name__  # numpy says "373. GiB"


@contextlib.contextmanager
def usable_streams():
    """Within the block every stream is there, takes every letter, and stderr never fails."""
    with contextlib.ExitStack() as stack:
        for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):  # in the order of their numbers
            if getattr(sys, name) is None:  # closed, as by 2>&-: the next file opened would take its number
                setattr(sys, name, stack.enter_context(open(os.devnull, mode)))
                stack.callback(setattr, sys, name, None)
        for stream in (sys.stdout, sys.stderr):
            if hasattr(stream, "reconfigure"):
                stream.reconfigure(errors="backslashreplace")  # a locale without the letter
        stack.enter_context(contextlib.redirect_stderr(Forgiving(sys.stderr)))
        yield


class Forgiving:
    """A stream whose words may be lost: no training ends because nobody takes its progress bar."""

    def __init__(self, stream):
        self._stream = stream

    def write(self, text):
        try:
            return self._stream.write(text)
        except OSError:
            silence(self._stream)
            return len(text)

    def flush(self):
        try:
            self._stream.flush()
        except OSError:
            silence(self._stream)

    def __getattr__(self, name):
        return getattr(self._stream, name)


def silence(stream, unless_it_works=False):
    """Let all that a stream still holds, and all that comes, go nowhere: Python would write it at its end, and complain."""
    with contextlib.suppress(OSError, ValueError):
        if unless_it_works:
            stream.flush()
            return
    with contextlib.suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
