"""Reader of PLUS/3D Slicer sequence files with tracker transforms (``.igs.mha``, ``.seq.mha``).

Such a file is a MetaImage: text lines ``key = value`` up to ``ElementDataFile``, then the pictures; what the frames
hold is in :mod:`trainer.drivers.sequence_frames`. ``DimSize`` ends with the number of frames; ``0 0 N`` is a file
without pictures.
"""

from __future__ import annotations

import math
from pathlib import Path

from trainer import image_header
from trainer.drivers import sequence_frames
from trainer.drivers.sequence_frames import Fields
from trainer.motion import Motion


def read(path: str | Path) -> Motion:
    """The recording in a sequence file; the pictures are not read. Raises ConfigError, one line."""
    name = str(path)
    header, fields, data_bytes = _read_header(Path(path))
    sizes = image_header.sizes(header, "DimSize", name)
    motion = sequence_frames.motion(fields, sizes[-1], "DimSize", name)
    _check_pixels(header, sizes, data_bytes, name)
    return motion


def _read_header(path: Path) -> tuple[dict[str, str], Fields, int]:
    """Header keys, the frames' keys, and the number of bytes after the header."""
    header, begins = image_header.read_meta_image(path)
    fields: Fields = {}
    header = {key: value for key, value in header.items() if not sequence_frames.keep(fields, key, value)}
    return header, fields, path.stat().st_size - begins


def _check_pixels(header: dict[str, str], sizes: list[int], data_bytes: int, name: str) -> None:
    """Compare the bytes behind the header with the pictures' size, where the header tells it.

    More bytes than needed are accepted: PLUS writes one for each frame of a recording without pictures.
    """
    elements = math.prod(sizes)
    if header["ElementDataFile"] != "LOCAL" or header.get("CompressedData", "False") == "True" or elements == 0:
        return
    kind, channels = image_header.element_type(header, name)
    image_header.check_length(data_bytes, elements * int(kind[1]) * channels, name)
