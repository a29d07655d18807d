"""``opt.txt``: the options that a published run was started with."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import TypeVar

OptionValue = bool | int | float | str
Options = Mapping[str, OptionValue]
_Number = TypeVar("_Number", int, float)


def parse_options(text: str) -> dict[str, OptionValue]:
    """Options of ``key: value`` lines: booleans, whole numbers, numbers, else the text as it stands.

    Lines that are none (the dashed first and last, remarks) are passed over; ``key = value`` is understood.
    """
    options: dict[str, OptionValue] = {}
    for line in text.splitlines():
        match = re.fullmatch(r"\s*(\w+)\s*[:=]\s*(.*?)\s*", line)
        if match:
            options[match[1]] = _value(match[2])
    return options


def read_options(folder: Path) -> dict[str, OptionValue]:
    """Options of ``folder/opt.txt``; none if there is no such file.

    Raises:
        ValueError: If the file is no text.
    """
    path = folder / "opt.txt"
    if not path.is_file():
        return {}
    try:
        return parse_options(path.read_text(encoding="utf-8"))
    except UnicodeDecodeError as error:
        raise ValueError(f"{path} is no text file.") from error


def number(options: Options, name: str, default: _Number) -> _Number:
    """A number among the options; ``default`` if it is not there.

    Raises:
        ValueError: If the option is there and no number of the default's kind.
    """
    value = options.get(name, default)
    if (
        isinstance(value, bool)
        or not isinstance(value, int | float)
        or (isinstance(default, int) and value != int(value))
    ):
        raise ValueError(f"Option {name!r} of opt.txt must be a number such as {default}, got {value!r}.")
    return type(default)(value)


def _value(text: str) -> OptionValue:
    if text in ("True", "False"):
        return text == "True"
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text
