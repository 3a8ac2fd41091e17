"""XML files as SUMO takes them: plain, or packed by gzip where their name says so."""

from __future__ import annotations

import gzip
from pathlib import Path
from typing import IO


def opened(path: Path) -> IO[bytes]:
    """The file, open for reading what it holds."""
    return gzip.open(path) if path.suffix == ".gz" else path.open("rb")  # type: ignore[return-value]
