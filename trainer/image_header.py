"""What sequence files of trackers and label volumes share of their headers.

MetaImage (``.mha``, ``.mhd``) is text lines ``key = value`` up to ``ElementDataFile``, then the elements.
"""

from __future__ import annotations

from pathlib import Path

from trainer.config import ConfigError

ELEMENT_TYPES = {
    "MET_CHAR": "i1", "MET_UCHAR": "u1", "MET_SHORT": "i2", "MET_USHORT": "u2", "MET_INT": "i4", "MET_UINT": "u4",
    "MET_LONG": "i4", "MET_ULONG": "u4", "MET_LONG_LONG": "i8", "MET_ULONG_LONG": "u8", "MET_FLOAT": "f4",
    "MET_DOUBLE": "f8",
}  # fmt: skip


def read_meta_image(path: Path) -> tuple[dict[str, str], int]:
    """The keys of a MetaImage's header in their order, and where the elements begin, in bytes. Raises ConfigError."""
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


def sizes(header: dict[str, str], key: str, name: str) -> list[int]:
    """The pictures' size along each axis, as the header's ``key`` has it. Raises ConfigError."""
    try:
        found = [int(text) for text in header[key].split()]
    except KeyError:
        raise ConfigError(f"{name}: the header has no '{key}'") from None
    except ValueError:
        found = []
    if not found or min(found) < 0:
        raise ConfigError(f"{name}: '{key}' expected whole numbers, found '{header[key]}'")
    return found


def element_type(header: dict[str, str], name: str) -> tuple[str, int]:
    """The type of MetaImage's elements in numpy's words, without byte order, and their channels. Raises ConfigError."""
    kind = header.get("ElementType", "")
    channels = header.get("ElementNumberOfChannels", "1")
    if kind not in ELEMENT_TYPES or not channels.isdecimal():
        raise ConfigError(f"{name}: unknown 'ElementType = {kind}' of {channels} channels")
    return ELEMENT_TYPES[kind], int(channels)


def check_length(data_bytes: int, expected: int, name: str) -> None:
    """Raises ConfigError where fewer bytes than ``expected`` stand behind the header; more are accepted."""
    if data_bytes < expected:
        raise ConfigError(
            f"{name}: the pictures are cut short: {data_bytes} of {expected} bytes are there; copy the file again"
        )
