"""A pipeline's networks, statistics and text encoder, and the folder that holds them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, ClassVar, Self

import torch

from controlmm.generation.motion_decoder import MotionDecoder
from controlmm.motion.normalizer import Normalizer
from controlmm.motion.skeleton import Skeleton
from controlmm.nn.checkpoint import PretrainedModel
from controlmm.pipelines import folder as files
from controlmm.text import TextEncoder, check_same_encoder, load_text_encoder


class PretrainedPipeline:
    """What can be loaded from a folder and saved as one."""

    kind: ClassVar[str]  # in pipeline.json, and the name of the model that comes with the package
    # By the names of their folders, which are those of the constructor's arguments and of attributes.
    network_classes: ClassVar[Mapping[str, type[PretrainedModel]]]
    optional_networks: ClassVar[tuple[str, ...]] = ("length", "residual_control")
    # Dataclasses that pipeline.json holds, by their names in it, which are the constructor's, too.
    settings: ClassVar[Mapping[str, Callable[[Mapping[str, Any]], Any]]] = {}
    decoder: MotionDecoder
    text_encoder: TextEncoder

    @classmethod
    def from_pretrained(
        cls, path: str | Path | None = None, *, text_encoder: TextEncoder | None = None
    ) -> Self:
        """Load a pipeline folder; without a path, the trained model that comes with the package.

        Args:
            path: A folder written by :meth:`save_pretrained`.
            text_encoder: Use this one instead of loading the one that the folder names; it must equal it.

        Raises:
            FileNotFoundError: If the folder or one of its files is missing.
            ValueError: If a file is damaged, or the text encoder is not the one used in training.
            ModuleNotFoundError: If the text encoder's weights are not installed.
        """
        folder = files.resolve_folder(path, shipped=cls.kind)
        about = files.read_pipeline(folder, cls.kind)
        encoder_config = files.read_json(folder / files.TEXT_ENCODER_FILE)
        if text_encoder is None:
            text_encoder = load_text_encoder(encoder_config)
        else:
            check_same_encoder(encoder_config, text_encoder)
        networks = {
            name: network.from_pretrained(folder / name)
            for name, network in cls.network_classes.items()
            if name not in cls.optional_networks or (folder / name).is_dir()
        }
        normalizer = Normalizer.load(folder / files.NORMALIZER_FILE)
        assembled: Callable[..., Self] = cls  # every subclass takes its networks by these names
        try:
            settings = {name: read(about[name]) for name, read in cls.settings.items() if name in about}
        except ValueError as error:
            raise ValueError(f"{folder / files.PIPELINE_FILE}: {error}") from error
        return assembled(**networks, normalizer=normalizer, text_encoder=text_encoder, **settings)

    def networks(self) -> dict[str, PretrainedModel]:
        """All networks by the names of their folders."""
        found = {name: getattr(self, name) for name in self.network_classes}
        return {name: network for name, network in found.items() if network is not None}

    @property
    def skeleton(self) -> Skeleton:
        """The joints that motions have and controls may name."""
        return self.decoder.normalizer.skeleton

    @property
    def num_parameters(self) -> int:
        """Parameters of all networks, the text encoder not counted."""
        return sum(p.numel() for network in self.networks().values() for p in network.parameters())

    def save_pretrained(self, path: str | Path, *, dtype: torch.dtype = torch.float32) -> Path:
        """Write the pipeline as a folder (safetensors and JSON); ``dtype=torch.float16`` halves it."""
        folder = Path(path)
        folder.mkdir(parents=True, exist_ok=True)
        for name, network in self.networks().items():
            network.save_pretrained(folder / name, dtype=dtype)
        self.decoder.normalizer.save(folder / files.NORMALIZER_FILE)
        files.write_json(folder / files.TEXT_ENCODER_FILE, self.text_encoder.config())
        about = {
            "kind": self.kind,
            "format": files.FORMAT,
            **{name: asdict(getattr(self, name)) for name in self.settings},
        }
        files.write_json(folder / files.PIPELINE_FILE, about)
        return folder
