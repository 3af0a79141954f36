"""MetaImage headers (``.mha``, ``.mhd``): text lines ``key = value`` up to ``ElementDataFile``, then the elements.

Sequence files with tracker poses and label volumes both begin with one.
"""

from __future__ import annotations

import math
from pathlib import Path

from trainer.config import ConfigError

ELEMENT_TYPES = {
    "MET_CHAR": "i1", "MET_UCHAR": "u1", "MET_SHORT": "i2", "MET_USHORT": "u2", "MET_INT": "i4", "MET_UINT": "u4",
    "MET_LONG": "i4", "MET_ULONG": "u4", "MET_LONG_LONG": "i8", "MET_ULONG_LONG": "u8", "MET_FLOAT": "f4",
    "MET_DOUBLE": "f8",
}  # fmt: skip


def read_header(path: Path) -> tuple[dict[str, str], int]:
    """The keys of the header in their order, and where the elements begin, in bytes. Raises ConfigError."""
    header: dict[str, str] = {}
    try:
        with path.open("rb") as file:
            for number, line in enumerate(file, 1):
                if not line.endswith(b"\n"):
                    break
                key, equals, value = line.decode("utf-8", "replace").partition("=")
                if not equals:
                    raise ConfigError(f"{path}: line {number} is not 'key = value'; expected a MetaImage")
                header[key.strip()] = value.strip()
                if key.strip() == "ElementDataFile":
                    return header, file.tell()
    except OSError as error:
        raise ConfigError(f"{path}: {'no such file' if not path.exists() else error.strerror}") from None
    raise ConfigError(f"{path}: the header is cut short: no line 'ElementDataFile = …' at its end; copy the file again")


def dimensions(header: dict[str, str], name: str) -> list[int]:
    """``DimSize``. Raises ConfigError when it is missing or not made of whole numbers."""
    try:
        sizes = [int(s) for s in header["DimSize"].split()]
    except KeyError:
        raise ConfigError(f"{name}: the header has no 'DimSize'") from None
    except ValueError:
        sizes = []
    if not sizes or min(sizes) < 0:
        raise ConfigError(f"{name}: 'DimSize' expected whole numbers, found '{header['DimSize']}'")
    return sizes


def element_type(header: dict[str, str], name: str) -> tuple[str, int]:
    """The elements' type as numpy calls it, without byte order, and the number of channels. Raises ConfigError."""
    kind = header.get("ElementType", "")
    channels = header.get("ElementNumberOfChannels", "1")
    if kind not in ELEMENT_TYPES or not channels.isdecimal():
        raise ConfigError(f"{name}: unknown 'ElementType = {kind}' of {channels} channels")
    return ELEMENT_TYPES[kind], int(channels)


def check_size(header: dict[str, str], found_bytes: int, name: str) -> None:
    """Raises ConfigError where fewer bytes are there than the header's elements take; more are accepted."""
    kind, channels = element_type(header, name)
    expected = math.prod(dimensions(header, name)) * int(kind[1]) * channels
    if found_bytes < expected:
        raise ConfigError(
            f"{name}: the elements are cut short: {found_bytes} of {expected} bytes are there; copy the file again"
        )
