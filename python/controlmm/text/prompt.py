"""The check that a prompt says something."""

from __future__ import annotations

_ADVICE = 'Describe the motion in words, for example "a person walks forward".'


def check_prompt(prompt: str) -> str:
    """The prompt without white space around it.

    Raises:
        ValueError: If it is not a string, or nothing is left of it.
    """
    if not isinstance(prompt, str):
        raise ValueError(f"`prompt` must be a string, got {type(prompt).__name__}. {_ADVICE}")
    stripped = prompt.strip()
    if not stripped:
        raise ValueError(f"`prompt` is empty. {_ADVICE}")
    return stripped
