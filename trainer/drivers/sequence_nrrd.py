"""Reader of PLUS/3D Slicer sequence files in the NRRD format (``.seq.nrrd``, ``.igs.nrrd``).

Text lines up to an empty one: ``NRRD000n``, fields ``name: value``, key/value pairs ``key:=value`` (among them what
:mod:`trainer.drivers.sequence_frames` reads) and comments ``#``; then the pictures. The number of frames is the size
of the axis whose kind is ``list`` or ``time``, or of the last axis. Compressed pictures are passed by, unread; the
length of others is compared with their size.
"""

from __future__ import annotations

import math
from pathlib import Path

from trainer import image_header
from trainer.config import ConfigError
from trainer.drivers import sequence_frames
from trainer.drivers.sequence_frames import Fields
from trainer.motion import Motion

#: Bytes of an element, by the last words of its type's name: "unsigned short int", "uint16_t", "uchar" …
ELEMENT_BYTES = {
    "char": 1, "uchar": 1, "int8": 1, "uint8": 1, "short": 2, "ushort": 2, "int16": 2, "uint16": 2, "int": 4,
    "uint": 4, "int32": 4, "uint32": 4, "longlong": 8, "ulonglong": 8, "int64": 8, "uint64": 8, "float": 4,
    "double": 8,
}  # fmt: skip


def read(path: str | Path) -> Motion:
    """The recording in a sequence file; the pictures are not read. Raises ConfigError, one line."""
    name = str(path)
    header, fields, data_bytes = _read_header(Path(path), name)
    sizes = image_header.sizes(header, "sizes", name)
    kinds = header.get("kinds", "").lower().split()
    axis = next((i for i, kind in enumerate(kinds) if kind in ("list", "time") and i < len(sizes)), -1)
    motion = sequence_frames.motion(fields, sizes[axis], "sizes", name)
    _check_pixels(header, sizes, data_bytes, name)
    return motion


def _read_header(path: Path, name: str) -> tuple[dict[str, str], Fields, int]:
    """Fields of the header, the frames' keys, and the number of bytes after the header."""
    header: dict[str, str] = {}
    fields: Fields = {}
    try:
        with path.open("rb") as file:
            if not file.readline().startswith(b"NRRD000"):
                raise ConfigError(f"{name}: does not begin with 'NRRD000n'; expected a NRRD sequence")
            for number, line in enumerate(file, 2):
                if not line.endswith(b"\n"):
                    break
                text = line.decode("utf-8", "replace").strip()
                if not text:
                    return header, fields, path.stat().st_size - file.tell()
                if text.startswith("#"):
                    continue
                key, colon, value = text.partition(":")
                if not colon:
                    raise ConfigError(f"{name}: line {number} is not 'key: value'; expected a NRRD sequence")
                value = value.removeprefix("=").strip()
                if not sequence_frames.keep(fields, key.strip(), value):
                    header[key.strip().lower()] = value
    except OSError as error:
        raise ConfigError(f"{name}: {'no such file' if not path.exists() else error.strerror}") from None
    raise ConfigError(f"{name}: the header is cut short: no empty line at its end; copy the file again")


def _check_pixels(header: dict[str, str], sizes: list[int], data_bytes: int, name: str) -> None:
    """Compare the bytes behind the header with the pictures' size, where they are raw and in this file."""
    elements = math.prod(sizes)
    if header.get("encoding", "raw").lower() != "raw" or "data file" in header or elements == 0:
        return
    kind = header.get("type", "").lower()
    short = kind.replace("unsigned ", "u").replace("signed ", "").removesuffix("_t")
    short = short.replace("long long", "longlong").removesuffix(" int")
    if short not in ELEMENT_BYTES:
        raise ConfigError(f"{name}: unknown 'type: {kind}'")
    image_header.check_length(data_bytes, elements * ELEMENT_BYTES[short], name)
