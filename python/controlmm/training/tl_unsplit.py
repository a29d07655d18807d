"""Stage of the ablation's tokenizer: one encoder and one codebook for the whole body."""

from __future__ import annotations

from controlmm.training import tl_vq
from controlmm.training.stage import Stage

STAGE = Stage(
    "tl-unsplit",
    tl_vq.STAGE.build,
    {size: config.unsplit() for size, config in tl_vq.STAGE.configs.items()},
    tl_vq.SETTINGS,
    system="tlcontrol",
    uses_text=False,
    starts_from_weights=False,
)
