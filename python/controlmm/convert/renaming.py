"""From the names of a published state dict to ours, with nothing left over and nothing missing."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import torch
from torch import nn

from controlmm.convert.torch_file import StateDict

Rule = tuple[str, str]  # pattern of a whole published name, and our name with \1, \2, ... for its groups
_SHOWN = 5  # names in an error message


def renamed(
    state: Mapping[str, torch.Tensor], rules: Sequence[Rule], *, ignored: Sequence[str] = ()
) -> StateDict:
    """``state`` under the names that the first fitting rule gives; ``ignored`` patterns are left out.

    Raises:
        ValueError: If a name fits no rule: the file is of another network than it seems.
    """
    result: StateDict = {}
    unknown = []
    for name, tensor in state.items():
        if any(re.fullmatch(pattern, name) for pattern in ignored):
            continue
        match = next(((m, new) for old, new in rules if (m := re.fullmatch(old, name))), None)
        if match is None:
            unknown.append(name)
        else:
            result[match[0].expand(match[1])] = tensor
    if unknown:
        raise ValueError(f"The checkpoint holds unknown weights: {shown(unknown)}.")
    return result


def load_strictly(network: nn.Module, state: StateDict, *, what: str) -> None:
    """Put ``state`` into ``network``.

    Raises:
        ValueError: If a weight is missing, left over, or has another shape.
    """
    wanted = network.state_dict()
    missing, extra = sorted(wanted.keys() - state.keys()), sorted(state.keys() - wanted.keys())
    if missing or extra:
        parts = [
            f"{word} {shown(names)}" for word, names in (("missing", missing), ("unknown", extra)) if names
        ]
        raise ValueError(f"The weights of the {what} are incomplete: {'; '.join(parts)}.")
    for name, tensor in state.items():
        if tensor.shape != wanted[name].shape:
            raise ValueError(
                f"Weight {name} of the {what} must have shape {tuple(wanted[name].shape)}, "
                f"got {tuple(tensor.shape)}."
            )
    network.load_state_dict(state)


def count_indices(state: Mapping[str, torch.Tensor], pattern: str) -> int:
    """How many different numbers the group of ``pattern`` takes among the names: layers, blocks, books."""
    return len({m.group(1) for name in state if (m := re.match(pattern, name))})


def weight(state: Mapping[str, torch.Tensor], name: str, *, what: str) -> torch.Tensor:
    """One weight that the sizes are read from.

    Raises:
        ValueError: If it is missing.
    """
    if name not in state:
        raise ValueError(f"The weights of the {what} are incomplete: missing {name}.")
    return state[name]


def shown(names: Sequence[str]) -> str:
    """The first few names, and how many more there are."""
    rest = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return ", ".join(names[:_SHOWN]) + rest
