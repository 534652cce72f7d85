"""Files that are never seen half-written."""

import contextlib
import os
from pathlib import Path


@contextlib.contextmanager
def complete_file(path):
    """A binary file to write to; it appears as `path` at once and complete when the block ends, or not at all."""
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with open(temporary, "wb") as file:
            yield file
        os.replace(temporary, path)
    except OSError as error:
        if error.filename == str(temporary):
            error.filename = str(path)  # whoever reads of it knows no other name
        raise
    finally:
        temporary.unlink(missing_ok=True)
