"""Typed configurations to and from plain dictionaries, checked field by field."""

import dataclasses
import difflib
import math
import types
import typing
from collections.abc import Iterator, Mapping, MutableMapping
from pathlib import Path
from typing import Any, TypeVar

T = TypeVar("T")


def to_dict(value: Any) -> Any:
    """Turn nested dataclasses into dictionaries of numbers, strings, lists and ``None``.

    Raises:
        TypeError: A field holds something that a JSON file cannot.
    """
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {
            field.name: to_dict(getattr(value, field.name)) for field in dataclasses.fields(value)
        }
    if isinstance(value, Mapping):
        return {str(key): to_dict(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return list(map(to_dict, value))
    if isinstance(value, Path):
        return str(value)
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    raise TypeError(f"a configuration cannot hold a {type(value).__name__}: {value!r}")


def from_dict(
    cls: type[T], values: Mapping[str, Any], *, where: str = "", over: T | None = None
) -> T:
    """Build the dataclass ``cls`` from what :func:`to_dict` wrote.

    Fields that are absent keep their default.

    With ``over`` they are as in that one, in groups too. Fields of earlier versions, which
    ``cls.GONE`` names, may be there with the value by which they did nothing.

    Raises:
        ValueError: A field that ``cls`` does not have, one that is needed and absent, or a value of
            the wrong type, named by its path, which begins with ``where``.
    """
    values = _without_gone(cls, values, where)
    hints = typing.get_type_hints(cls)
    fields = dataclasses.fields(cls)  # type: ignore[arg-type]
    names = {field.name for field in fields}
    unknown = sorted(map(str, set(values) - names))
    if unknown:
        meant = _meant(unknown[0], names, hints)
        raise ValueError(
            f"{where or cls.__name__} has no field {', '.join(unknown)}; {meant}it has "
            f"{', '.join(sorted(names))}"
        )
    left_out = needed(cls) - values.keys()
    if left_out and over is None:
        raise ValueError(f"{where or cls.__name__} has no {', '.join(sorted(left_out))}; name it")
    prefix = f"{where}." if where else ""
    converted = {}
    for name, item in values.items():
        converted[name] = _convert(hints[name], item, prefix + name, getattr(over, name, None))
    if over is None:
        return cls(**converted)
    return dataclasses.replace(over, **converted)  # type: ignore[type-var]


def _without_gone(cls: type, values: Mapping[str, Any], where: str) -> dict[str, Any]:
    """The fields but those that are gone and did nothing.

    Raises:
        ValueError: One that is gone did something.
    """
    kept = dict(values)
    for name, off in getattr(cls, "GONE", {}).items():
        value = kept.pop(name, off)
        if to_dict(value) != off:
            raise ValueError(f"{where or cls.__name__}.{name} = {value} is gone; {off} is allowed")
    return kept


def needed(cls: type) -> set[str]:
    """Names of the fields of a dataclass that have no default."""
    names = set()
    for field in dataclasses.fields(cls):
        if field.default is field.default_factory is dataclasses.MISSING:
            names.add(field.name)
    return names


def _meant(name: str, names: set[str], hints: Mapping[str, Any]) -> str:
    """Asks for the field that ``name`` may mean, one of a group or one that is spelled alike."""
    for group in sorted(names):
        kind = hints[group]
        if dataclasses.is_dataclass(kind) and name in {f.name for f in dataclasses.fields(kind)}:
            return f"is it {group}.{name}? "
    for likely in difflib.get_close_matches(name, sorted(names), 1):
        return f"is it {likely}? "
    return ""


def _convert(hint: Any, value: Any, where: str, over: Any = None) -> Any:
    """``value`` as the type ``hint`` asks for.

    Nested dataclasses, tuples, paths and unions of them.

    Of a dataclass ``over`` has what is left out.
    """
    if hint is Any:
        return value
    origin = typing.get_origin(hint)
    args = typing.get_args(hint)
    if origin is typing.Annotated:
        return _convert(args[0], value, where, over)
    if origin in (typing.Union, types.UnionType):
        return _convert_union(args, value, where, over)
    if origin is tuple:
        return _convert_tuple(args, value, where)
    if dataclasses.is_dataclass(hint) and isinstance(hint, type):
        named = _mapping(value, f"fields of {hint.__name__}", where)
        return from_dict(hint, named, where=where, over=over if isinstance(over, hint) else None)
    if origin in (dict, MutableMapping):  # of the second tyro makes one flag, filled or not
        named = _mapping(value, "values by name", where)
        return {key: _convert(args[1], item, f"{where}.{key}") for key, item in named.items()}
    if origin is typing.Literal:
        if value not in args:
            raise ValueError(f"{where}: {value!r} is not one of {', '.join(map(repr, args))}")
        return value
    return _convert_plain(hint, value, where) if isinstance(hint, type) else value


def _mapping(value: Any, wanted: str, where: str) -> Mapping[str, Any]:
    """``value``, if it has names."""
    if not isinstance(value, Mapping):
        raise ValueError(f"{where}: expected {wanted}, got {value!r}")
    return value


def _convert_tuple(args: tuple[Any, ...], value: Any, where: str) -> tuple[Any, ...]:
    """``value`` as a tuple of what ``args`` say."""
    if not isinstance(value, (list, tuple)):
        raise ValueError(f"{where}: expected a list, [{value!r}]")
    inner = args[:1] * len(value) if args[-1:] == (Ellipsis,) else args
    if len(inner) != len(value):
        raise ValueError(f"{where}: expected {len(inner)} values, got {len(value)}")
    pairs = enumerate(zip(inner, value, strict=True))
    return tuple(_convert(each, item, f"{where}[{i}]") for i, (each, item) in pairs)


def _convert_plain(kind: type, value: Any, where: str) -> Any:
    """``value`` as a number, text or path."""
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if kind is Path and isinstance(value, str):
        return Path(value)
    if not isinstance(value, kind) or (kind is int and isinstance(value, bool)):
        raise ValueError(f"{where}: expected {kind.__name__}, got {value!r}")
    return value


def _convert_union(options: tuple[Any, ...], value: Any, where: str, over: Any) -> Any:
    """``value`` as the first of ``options`` that takes it."""
    if value is None and type(None) in options:
        return None
    errors = []
    for option in options:
        if option is type(None):
            continue
        try:
            return _convert(option, value, where, over)
        except ValueError as error:
            errors.append(str(error))
    raise ValueError("; ".join(errors) or f"{where}: cannot be {value!r}")


def leaves(values: Any, where: str = "") -> Iterator[tuple[str, Any]]:
    """Plain values of nested dictionaries and lists by path, such as ``hand.upper_rad[3]``."""
    if isinstance(values, Mapping):
        for key, item in values.items():
            yield from leaves(item, f"{where}.{key}" if where else str(key))
    elif isinstance(values, (list, tuple)):
        for index, item in enumerate(values):
            yield from leaves(item, f"{where}[{index}]")
    else:
        yield where, values


def require(
    cfg: Any,
    prefix: str,
    what: typing.Literal["positive", "zero or positive", "in [0, 1]", "an angle"],
    names: str,
) -> None:
    """Refuse fields that are not ``what``; those that are ``None`` are not set.

    Args:
        cfg: A dataclass with these fields.
        prefix: What stands before the name of a field in messages, such as ``--ppo.`` or ``goal.``.
        what: What the fields have to be.
        names: Fields, with spaces between.

    Raises:
        ValueError: The field or flag, its value and what it has to be.
    """
    for name in names.split():
        value = getattr(cfg, name)
        if value is None:
            continue
        largest = {"in [0, 1]": 1.0, "an angle": math.pi + 1e-6}.get(what, math.inf)
        zero = what in ("zero or positive", "in [0, 1]") and value == 0
        if not (zero or 0 < value <= largest):
            shown = name.replace("_", "-") if prefix.startswith("--") else name
            remedy: str = what
            if what == "an angle":
                degrees = f"; {value:g} degrees are {math.radians(value):.3g}" if value > 0 else ""
                remedy = f"positive and at most pi [rad]{degrees}"
            raise ValueError(f"{prefix}{shown} is {value}; it has to be {remedy}")
