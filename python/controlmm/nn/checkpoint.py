"""``save_pretrained`` / ``from_pretrained`` for networks: ``config.json`` beside ``model.safetensors``."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any, ClassVar, Self

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import nn

CONFIG_FILE, WEIGHTS_FILE = "config.json", "model.safetensors"


class PretrainedModel(nn.Module):
    """A network that is built from a frozen dataclass ``config`` and knows how to save and load itself."""

    config_class: ClassVar[type]
    training_state: ClassVar[tuple[str, ...]] = ()  # last parts of buffer names that only training needs

    def __init__(self, config: Any) -> None:
        super().__init__()
        self.config = config

    @property
    def device(self) -> torch.device:
        """Where the network is."""
        return next(self.parameters()).device

    def save_pretrained(self, folder: str | Path, *, dtype: torch.dtype = torch.float32) -> None:
        """Write config and weights; ``dtype=torch.float16`` halves the file."""
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        write_config(folder / CONFIG_FILE, self.config)
        state = {
            name: (value.to(dtype) if value.is_floating_point() else value).contiguous()
            for name, value in self.state_dict().items()
            if name.rpartition(".")[2] not in self.training_state
        }
        unfinished = folder / (WEIGHTS_FILE + ".tmp")
        save_file(state, unfinished)
        unfinished.replace(folder / WEIGHTS_FILE)  # whole or old, also when the process is killed

    @classmethod
    def from_pretrained(cls, folder: str | Path) -> Self:
        """Rebuild a network in evaluation mode, float32, from :meth:`save_pretrained`'s folder.

        Raises:
            FileNotFoundError: If a file is missing.
            ValueError: If a file is damaged, or the weights do not fit the configuration.
        """
        folder = Path(folder)
        model = cls(read_config(folder / CONFIG_FILE, cls.config_class))
        fresh = model.state_dict()
        kept = {name: fresh[name] for name in fresh if name.rpartition(".")[2] in cls.training_state}
        try:
            model.load_state_dict(kept | read_weights(folder / WEIGHTS_FILE))
        except RuntimeError as error:
            reason = " ".join(str(error).split())
            raise ValueError(f"{folder / WEIGHTS_FILE} does not fit its {CONFIG_FILE}: {reason}") from error
        return model.eval()


def read_weights(path: Path) -> dict[str, torch.Tensor]:
    """Tensors of a safetensors file.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is damaged or truncated.
    """
    if not path.is_file():
        raise FileNotFoundError(f"No weights at {path}.")
    try:
        return load_file(path)
    except SafetensorError as error:
        raise ValueError(f"{path} is damaged or truncated ({error}). Copy or train it again.") from error


def write_config(path: Path, config: Any) -> None:
    """Write a dataclass as JSON."""
    path.write_text(json.dumps(dataclasses.asdict(config), indent=2) + "\n", encoding="utf-8")


def read_config(path: Path, config_class: type) -> Any:
    """Read a dataclass back; unknown keys are an error.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If the JSON is broken or does not describe ``config_class``.
    """
    if not path.is_file():
        raise FileNotFoundError(f"No {path.name} in {path.parent}.")
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
        known = {field.name: field for field in dataclasses.fields(config_class)}
        if not isinstance(values, dict) or not set(values) <= set(known):
            unknown = sorted(set(values) - set(known)) if isinstance(values, dict) else type(values).__name__
            raise ValueError(f"unexpected {unknown} for {config_class.__name__}")
        return config_class(**{name: tuple(v) if isinstance(v, list) else v for name, v in values.items()})
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path} is no valid configuration: {error}.") from error
