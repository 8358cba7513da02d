"""Redirect to the log what libraries print on stderr past Python."""

from __future__ import annotations

import logging
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager

logger = logging.getLogger(__name__)


@contextmanager
def unprinted(library: str) -> Iterator[None]:
    """Redirect to the log what a library writes on stderr; users cannot act on it."""
    with tempfile.TemporaryFile() as said:
        own = os.dup(2)
        os.dup2(said.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(own, 2)
            os.close(own)
            said.seek(0)
            if text := said.read().decode(errors="replace").strip():
                logger.debug("%s: %s", library, text)
