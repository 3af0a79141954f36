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
    n = _dimensions(header, name)[-1]
    motion = sequence_frames.motion(fields, n, "DimSize", name)
    _check_pixels(header, data_bytes, name)
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


def _dimensions(header: dict[str, str], name: str) -> list[int]:
    try:
        sizes = [int(s) for s in header["DimSize"].split()]
    except KeyError:
        raise ConfigError(f"{name}: the header has no 'DimSize'") from None
    except ValueError:
        sizes = []
    if not sizes or min(sizes) < 0:
        raise ConfigError(f"{name}: 'DimSize' expected whole numbers, found '{header['DimSize']}'")
    return sizes


def _check_pixels(header: dict[str, str], data_bytes: int, name: str) -> None:
    """Compare the bytes behind the header with the pictures' size, where the header tells it.

    More bytes than needed are accepted: PLUS writes one for each frame of a recording without pictures.
    """
    elements = math.prod(_dimensions(header, name))
    if header["ElementDataFile"] != "LOCAL" or header.get("CompressedData", "False") == "True" or elements == 0:
        return
    kind = header.get("ElementType", "")
    channels = header.get("ElementNumberOfChannels", "1")
    if kind not in ELEMENT_BYTES or not channels.isdecimal():
        raise ConfigError(f"{name}: unknown 'ElementType = {kind}' of {channels} channels")
    expected = elements * ELEMENT_BYTES[kind] * int(channels)
    if data_bytes < expected:
        raise ConfigError(
            f"{name}: the pictures are cut short: {data_bytes} of {expected} bytes are there; copy the file again"
        )
