"""Control files written by tests, and the one line that a bad one gets."""

from __future__ import annotations

import json
import re

import pytest

from controlmm.controls import load_controls


def write(path, document):
    path.write_text(document if isinstance(document, str) else json.dumps(document), encoding="utf-8")
    return path


def error_of(path):
    with pytest.raises(ValueError, match=re.escape(str(path))) as caught:
        load_controls(path)
    message = str(caught.value)
    assert "\n" not in message
    return message.removeprefix(f"{path}: ")
