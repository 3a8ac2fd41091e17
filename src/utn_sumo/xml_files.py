"""XML files as SUMO takes them: plain, or packed by gzip where their name says so."""

from __future__ import annotations

import gzip
from pathlib import Path
from typing import IO


def opened(path: Path) -> IO[bytes]:
    """The file, open for reading what it holds."""
    return gzip.open(path) if path.suffix == ".gz" else path.open("rb")  # type: ignore[return-value]


def stem(net_file: Path) -> str:
    """The name of a net file without its endings: what goes with a net lies beside it under this name."""
    return net_file.name.removesuffix(".gz").removesuffix(".xml").removesuffix(".net")
