"""Reader of PLUS/3D Slicer sequence files with tracker transforms (``.igs.mha``, ``.seq.mha``).

Such a file is a MetaImage: text lines ``key = value`` up to ``ElementDataFile``, then the pictures; what the frames
hold is in :mod:`trainer.drivers.sequence_frames`. ``DimSize`` ends with the number of frames; ``0 0 N`` is a file
without pictures.
"""

from __future__ import annotations

import math
from pathlib import Path

from trainer.config import ConfigError
from trainer.drivers import sequence_frames
from trainer.drivers.sequence_frames import Fields
from trainer.motion import Motion

ELEMENT_BYTES = {
    "MET_CHAR": 1, "MET_UCHAR": 1, "MET_SHORT": 2, "MET_USHORT": 2, "MET_INT": 4, "MET_UINT": 4, "MET_LONG": 4,
    "MET_ULONG": 4, "MET_LONG_LONG": 8, "MET_ULONG_LONG": 8, "MET_FLOAT": 4, "MET_DOUBLE": 8,
}  # fmt: skip


def read(path: str | Path) -> Motion:
    """The recording in a sequence file; the pictures are not read. Raises ConfigError, one line."""
    name = str(path)
    header, fields, data_bytes = _read_header(Path(path), name)
    sizes = sequence_frames.sizes(header, "DimSize", name)
    motion = sequence_frames.motion(fields, sizes[-1], "DimSize", name)
    _check_pixels(header, sizes, data_bytes, name)
    return motion


def _read_header(path: Path, name: str) -> tuple[dict[str, str], Fields, int]:
    """Header keys, the frames' keys, and the number of bytes after the header."""
    header: dict[str, str] = {}
    fields: Fields = {}
    try:
        with path.open("rb") as file:
            for number, line in enumerate(file, 1):
                if not line.endswith(b"\n"):
                    break
                key, equals, value = line.decode("utf-8", "replace").partition("=")
                if not equals:
                    raise ConfigError(f"{name}: line {number} is not 'key = value'; expected a MetaImage sequence")
                key, value = key.strip(), value.strip()
                if sequence_frames.keep(fields, key, value):
                    continue
                header[key] = value
                if key == "ElementDataFile":
                    return header, fields, path.stat().st_size - file.tell()
    except OSError as error:
        raise ConfigError(f"{name}: {'no such file' if not path.exists() else error.strerror}") from None
    raise ConfigError(f"{name}: the header is cut short: no line 'ElementDataFile = …' at its end; copy the file again")


def _check_pixels(header: dict[str, str], sizes: list[int], data_bytes: int, name: str) -> None:
    """Compare the bytes behind the header with the pictures' size, where the header tells it.

    More bytes than needed are accepted: PLUS writes one for each frame of a recording without pictures.
    """
    elements = math.prod(sizes)
    if header["ElementDataFile"] != "LOCAL" or header.get("CompressedData", "False") == "True" or elements == 0:
        return
    kind = header.get("ElementType", "")
    channels = header.get("ElementNumberOfChannels", "1")
    if kind not in ELEMENT_BYTES or not channels.isdecimal():
        raise ConfigError(f"{name}: unknown 'ElementType = {kind}' of {channels} channels")
    sequence_frames.check_length(data_bytes, elements * ELEMENT_BYTES[kind] * int(channels), name)
