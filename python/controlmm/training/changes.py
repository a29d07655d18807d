"""Fields of configurations changed by name, as a command line gives them."""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Mapping
from typing import Any


def with_changes(parts: Mapping[str, Any], given: Mapping[str, str]) -> dict[str, Any]:
    """``parts`` (dataclasses) with the fields named in ``given`` replaced by the values written there.

    Every name goes to the first part that has such a field.

    Raises:
        ValueError: If no part has the field, or the text is no value of its type.
    """
    changed = dict(parts)
    for name, text in given.items():
        owner = next((key for key, part in changed.items() if name in _fields(part)), None)
        if owner is None:
            known = sorted({field for part in changed.values() for field in _fields(part)})
            raise ValueError(f"There is no option {name!r}. Options: {', '.join(known)}.")
        kind = typing.get_type_hints(type(changed[owner]))[name]
        changed[owner] = dataclasses.replace(changed[owner], **{name: _parse(name, text, kind)})
    return changed


def _fields(part: Any) -> dict[str, Any]:
    return {field.name: field for field in dataclasses.fields(part)} if dataclasses.is_dataclass(part) else {}


def _parse(name: str, text: str, kind: Any) -> Any:
    if typing.get_origin(kind) in (types.UnionType, typing.Union):  # the latter: of a Literal and None
        kinds = typing.get_args(kind)
        if text == "none" and types.NoneType in kinds:
            return None
        (kind,) = (part for part in kinds if part is not types.NoneType)
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is tuple:
        return tuple(_parse(name, item, arguments[0]) for item in text.split(",") if item)
    if origin is typing.Literal:
        return _one_of(name, text, {str(value): value for value in arguments})
    if kind is bool:
        return _one_of(name, text, {"true": True, "false": False})
    try:
        return kind(text)
    except ValueError as error:
        raise ValueError(f"Option {name!r} must be a value of type {kind.__name__}, got {text!r}.") from error


def _one_of(name: str, text: str, values: Mapping[str, Any]) -> Any:
    if text not in values:
        raise ValueError(f"Option {name!r} must be one of {', '.join(values)}, got {text!r}.")
    return values[text]
