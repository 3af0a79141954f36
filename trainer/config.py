"""TOML files into frozen dataclasses, with errors that name file, key and what was expected.

The dataclass is the schema: a field without default is required, its type is what the TOML must hold,
and an unknown key is an error that suggests the nearest known one (so that ``wall_um`` is told to be
``wall_mm``). A physical number may be a :class:`Sourced` value: ``{ value = 1.0, source = "…" }``.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import tomllib
import types
import typing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

T = TypeVar("T")


class ConfigError(ValueError):
    """A file that cannot be used; the text is one line, fit to be shown to its author."""


@dataclass(frozen=True)
class Sourced:
    """A physical number and where it comes from; ``source`` begins with "assumed" where nobody measured it."""

    value: float
    source: str


@dataclass(frozen=True)
class Bounds:
    """The range a number must lie in; attached to a field with ``field(metadata={"bounds": Bounds(...)})``."""

    low: float = -math.inf
    high: float = math.inf
    low_open: bool = False

    def accepts(self, value: float) -> bool:
        return (value > self.low if self.low_open else value >= self.low) and value <= self.high

    def __str__(self) -> str:
        parts = []
        if self.low > -math.inf:
            parts.append(f"{'>' if self.low_open else '>='} {_number(self.low)}")
        if self.high < math.inf:
            parts.append(f"<= {_number(self.high)}")
        return " and ".join(parts)


#: Bounds of numbers in any file, far outside of surgery: what lies beyond is a slip of the pen or of the unit, and
#: would overflow in a simulation. All assumed.
LENGTH_MM = {"bounds": Bounds(1e-4, 1000.0)}
POSITION_MM = {"bounds": Bounds(-1e5, 1e5)}
ANGLE_DEG = {"bounds": Bounds(-360.0, 360.0)}


def read_toml(path: Path) -> dict[str, Any]:
    """The table in a TOML file. Raises ConfigError when it is missing, unreadable or not TOML."""
    return parse_toml(read_text(path), str(path))


def read_text(path: Path) -> str:
    """The text of a file. Raises ConfigError when it is missing or not UTF-8."""
    try:
        return path.read_text(encoding="utf-8-sig")  # a mark at its beginning is a spreadsheet's
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file") from None
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not UTF-8 text"
        raise ConfigError(f"{path}: {reason}") from None


def parse_toml(text: str, name: str) -> dict[str, Any]:
    """The table in a TOML text; ``name`` is used in errors. Raises ConfigError."""
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{name}: not valid TOML: {error}") from None


def build(cls: type[T], table: Any, name: str, key: str = "") -> T:
    """An instance of the dataclass ``cls`` from a TOML table found at ``key`` of the file ``name``."""
    where = f"{name}: [{key}]" if key else name
    if not isinstance(table, dict):
        raise ConfigError(f"{where}: expected a table, found {_describe(table)}")
    hints = typing.get_type_hints(cls)
    fields = {f.name: f for f in dataclasses.fields(cls) if f.init}  # type: ignore[arg-type]
    for given in table:
        if given not in fields:
            near = difflib.get_close_matches(given, fields, n=1, cutoff=0.5)
            hint = f", did you mean '{near[0]}'?" if near else f"; known keys: {', '.join(fields)}"
            raise ConfigError(f"{where}: unknown key '{given}'{hint}")
    values: dict[str, Any] = {}
    for field_name, field in fields.items():
        path = f"{key}.{field_name}" if key else field_name
        if field_name in table:
            bounds = field.metadata.get("bounds")
            values[field_name] = _convert(hints[field_name], table[field_name], name, path, bounds)
        elif field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
            expected = _type_name(hints[field_name])
            raise ConfigError(f"{where}: missing key '{field_name}' (expected {expected})")
    try:
        return cls(**values)
    except ConfigError:
        raise
    except ValueError as error:  # a rule between fields, stated by the dataclass itself
        raise ConfigError(f"{where}: {error}") from None


def _convert(kind: Any, value: Any, name: str, key: str, bounds: Bounds | None) -> Any:
    origin = typing.get_origin(kind)
    arguments = typing.get_args(kind)
    if origin in (typing.Union, types.UnionType):
        inner = next(a for a in arguments if a is not type(None))
        return _convert(inner, value, name, key, bounds)
    if origin is typing.Literal:
        if value not in arguments:
            raise ConfigError(f"{name}: '{key}' must be one of {', '.join(map(repr, arguments))}, found {value!r}")
        return value
    if origin is tuple:
        return _sequence(arguments, value, name, key, bounds)
    if origin is dict:
        if not isinstance(value, dict):
            raise ConfigError(f"{name}: '{key}' expected a table, found {_describe(value)}")
        return {k: _convert(arguments[1], v, name, f"{key}.{k}", bounds) for k, v in value.items()}
    if kind is Sourced:
        sourced = build(Sourced, value, name, key)
        _check_bounds(sourced.value, name, key, bounds)
        if not sourced.source.strip():
            raise ConfigError(f"{name}: '{key}.source' is empty; name the source or write 'assumed: …'")
        return sourced
    if dataclasses.is_dataclass(kind):
        return build(typing.cast("type[Any]", kind), value, name, key)
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        value = _as_float(value, name, key)
    if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
        raise ConfigError(f"{name}: '{key}' expected {_type_name(kind)}, found {_describe(value)}")
    if kind in (int, float):
        _check_bounds(value, name, key, bounds)
    return value


def _sequence(arguments: tuple[Any, ...], value: Any, name: str, key: str, bounds: Bounds | None) -> tuple[Any, ...]:
    if not isinstance(value, list):
        raise ConfigError(f"{name}: '{key}' expected a list, found {_describe(value)}")
    if arguments[-1] is Ellipsis:
        kinds: list[Any] = [arguments[0]] * len(value)
    else:
        kinds = list(arguments)
        if len(value) != len(kinds):
            raise ConfigError(f"{name}: '{key}' expected {len(kinds)} values, found {len(value)}")
    return tuple(
        _convert(kind, v, name, f"{key}[{i}]", bounds) for i, (kind, v) in enumerate(zip(kinds, value, strict=True))
    )


def _as_float(value: int, name: str, key: str) -> float:
    """TOML's whole numbers have any length here, a float has its end."""
    try:
        return float(value)
    except OverflowError:
        raise ConfigError(f"{name}: '{key}' must be finite, found a number of {value.bit_length()} bits") from None


def _check_bounds(value: float, name: str, key: str, bounds: Bounds | None) -> None:
    if not math.isfinite(_as_float(value, name, key) if isinstance(value, int) else value):
        raise ConfigError(f"{name}: '{key}' must be finite, found {value}")
    if bounds is not None and not bounds.accepts(value):
        raise ConfigError(f"{name}: '{key}' must be {bounds}, found {_number(value)}")


def _number(value: float) -> str:
    """Whole numbers with all their digits: a seed's bound has nineteen."""
    return str(value) if isinstance(value, int) else f"{value:g}"


def _type_name(kind: Any) -> str:
    names = {
        float: "a number",
        int: "a whole number",
        str: "a text",
        bool: "true or false",
        Sourced: "{ value, source }",
    }
    if kind in names:
        return names[kind]
    origin = typing.get_origin(kind)
    if origin in (typing.Union, types.UnionType):
        return _type_name(typing.get_args(kind)[0])
    if origin is tuple:
        return "a list"
    return "one of " + ", ".join(map(repr, typing.get_args(kind))) if origin is typing.Literal else "a table"


def _describe(value: Any) -> str:
    return f"{type(value).__name__} {str(value)[:40]!r}"
