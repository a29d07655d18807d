"""Stage that refines the decoder of ControlMM's tokenizer, see ``decoder_refinement.py``."""

from __future__ import annotations

from controlmm.models.rvq_vae import RvqVae, RvqVaeConfig
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

_STAGE = "rvq-decoder"


def _build(_: RvqVaeConfig, inputs: StageInputs) -> Recipe:
    model = tokenizer_to_refine(RvqVae, "rvq", inputs)
    return DecoderRecipe(
        model,
        Normalizer.load(inputs.root / NORMALIZER_FILE),
        inputs.train_clips,
        inputs.val_clips,
        stage=_STAGE,
        options=inputs.options,
        layer_dropout=model.config.quantize_dropout,
        progress=inputs.progress,
    )


STAGE = Stage(
    _STAGE,
    _build,
    by_size(RvqVaeConfig),  # not read: the sizes are those of the trained tokenizer
    SETTINGS,
    ("rvq",),
    network="tokenizer",
    uses_text=False,
    options=DecoderOptions(),
    samples=rebuilt_clips,
)
