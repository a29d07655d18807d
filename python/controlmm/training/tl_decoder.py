"""Stage that refines the decoder of TLControl's tokenizer, see ``decoder_refinement.py``."""

from __future__ import annotations

from controlmm.models.part_vq_vae import PartVqVae, PartVqVaeConfig
from controlmm.motion.normalizer import Normalizer
from controlmm.training.decoder_refinement import (
    SETTINGS,
    DecoderOptions,
    DecoderRecipe,
    tokenizer_to_refine,
)
from controlmm.training.recipe import Recipe
from controlmm.training.samples import rebuilt_clips
from controlmm.training.stage import NORMALIZER_FILE, Stage, StageInputs, by_size

_STAGE = "tl-decoder"


def _build(_: PartVqVaeConfig, inputs: StageInputs) -> Recipe:
    model = tokenizer_to_refine(PartVqVae, "tl-vq", inputs)
    if model.config.latent_norm == "clip":
        raise ValueError(
            f"Stage {_STAGE!r} needs a tokenizer with `latent_norm` 'step'; that in {inputs.root / 'tl-vq'} "
            "has 'clip' (published), whose codes are those of clips padded to 196 frames only. Train `tl-vq` "
            "with --config small."
        )
    return DecoderRecipe(
        model,
        Normalizer.load(inputs.root / NORMALIZER_FILE),
        inputs.train_clips,
        inputs.val_clips,
        stage=_STAGE,
        options=inputs.options,
        progress=inputs.progress,
    )


STAGE = Stage(
    _STAGE,
    _build,
    by_size(PartVqVaeConfig),  # not read: the sizes are those of the trained tokenizer
    SETTINGS,
    ("tl-vq",),
    system="tlcontrol",
    network="tokenizer",
    uses_text=False,
    options=DecoderOptions(),
    samples=rebuilt_clips,
)
