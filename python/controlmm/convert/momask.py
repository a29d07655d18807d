"""The four networks of MoMask in their published layout: tokenizer, two transformers, length estimator.

Sizes come from the shapes of the weights; only what shapes do not show (heads, dropout) comes from opt.txt.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import nn

from controlmm.convert.options_file import Options, number
from controlmm.convert.renaming import Rule, count_indices, load_strictly, renamed, weight
from controlmm.convert.torch_file import StateDict
from controlmm.models.length_estimator import LengthEstimator, LengthEstimatorConfig
from controlmm.models.masked_transformer import MaskedTransformer, MaskedTransformerConfig
from controlmm.models.residual_transformer import ResidualTransformer, ResidualTransformerConfig
from controlmm.models.rvq_vae import RvqVae, RvqVaeConfig

IGNORED = (r"clip_model\..*", r"position_enc\.pe")  # CLIP has its own files, position codes are a formula
_BLOCK = {"conv1": "dilated", "conv2": "pointwise"}

TRANSFORMER_RULES: tuple[Rule, ...] = (
    (r"input_process\.poseEmbedding\.(.+)", r"token_proj.\1"),
    (r"cond_emb\.(.+)", r"text_proj.\1"),
    (r"seqTransEncoder\.(layers\..+)", r"\1"),
    (r"output_process\.dense\.(.+)", r"head.0.\1"),
    (r"output_process\.LayerNorm\.(.+)", r"head.2.\1"),
    (r"output_process\.poseFinal\.(.+)", r"head.3.\1"),
)
MASKED_RULES: tuple[Rule, ...] = (*TRANSFORMER_RULES, (r"token_emb\.weight", "token_embedding.weight"))
_RESIDUAL_RULES: tuple[Rule, ...] = (
    *TRANSFORMER_RULES,
    ("embed_proj_shared_weight", "shared_tables"),
    ("token_embed_weight_", "first_table"),
    ("output_proj_weight_", "last_table"),
    (r"quant_emb\.(.+)", r"layer_proj.\1"),
)


def import_rvq(state: StateDict, options: Options) -> RvqVae:
    """The tokenizer.

    Raises:
        ValueError: If weights are missing, unknown or misshapen, or an option asks for an unknown variant.
    """
    _check_variant(options, "vq_act", "relu")
    _check_variant(options, "vq_norm", "None")
    what = "tokenizer"
    stages = count_indices(state, r"encoder\.model\.(\d+)\.0\.weight")
    books = [state[name] for name in sorted(state) if name.startswith("quantizer.layers.")]
    first, last = weight(state, "encoder.model.0.weight", what=what), f"encoder.model.{2 + stages}.weight"
    is_shared = len(books) > 1 and all(torch.equal(book, books[0]) for book in books[1:])
    config = RvqVaeConfig(
        feature_dim=first.shape[1],
        codebook_size=weight(state, "quantizer.layers.0.codebook", what=what).shape[0],
        code_dim=weight(state, last, what=what).shape[0],
        num_quantizers=len(books),
        width=first.shape[0],
        depth=count_indices(state, r"encoder\.model\.2\.1\.model\.(\d+)\."),
        downsample=2**stages,
        ema_decay=number(options, "mu", 0.99),
        shared_codebook=is_shared,
        quantize_dropout=number(options, "quantize_dropout_prob", 0.2),
    )
    network = RvqVae(config)
    weights = renamed(
        state, [*encoder_rules("encoder", stages), *decoder_rules(stages), *_book_rules(is_shared)]
    )
    load_strictly(network, weights | codebook_state(network, weights), what=what)
    return network.eval()


def import_masked(state: StateDict, options: Options) -> MaskedTransformer:
    """The masked transformer, or the base transformer inside a control checkpoint.

    Raises:
        ValueError: If weights are missing, unknown or misshapen.
    """
    what = "masked transformer"
    table = weight(state, "token_emb.weight", what=what)
    config = MaskedTransformerConfig(
        codebook_size=weight(state, "output_process.poseFinal.weight", what=what).shape[0],
        token_dim=table.shape[1],
        text_dropout=number(options, "cond_drop_prob", 0.1),
        **trunk_sizes(state, options, what=what),
    )
    network = MaskedTransformer(config)
    load_strictly(network, renamed(state, MASKED_RULES, ignored=IGNORED), what=what)
    return network.eval()


def import_residual(state: StateDict, options: Options) -> ResidualTransformer:
    """The residual transformer with shared tables (``share_weight``), as all published ones are.

    Raises:
        ValueError: If weights are missing, unknown or misshapen, or its tables are not shared.
    """
    what = "residual transformer"
    if options.get("share_weight", True) is False:
        raise ValueError(
            "The residual transformer was trained without `share_weight`; no such one is published."
        )
    shared = weight(state, "embed_proj_shared_weight", what=what)
    config = ResidualTransformerConfig(
        codebook_size=shared.shape[1] - 1,
        num_quantizers=shared.shape[0] + 2,
        token_dim=shared.shape[2],
        text_dropout=number(options, "cond_drop_prob", 0.2),
        **trunk_sizes(state, options, what=what),
    )
    network = ResidualTransformer(config)
    load_strictly(network, renamed(state, _RESIDUAL_RULES, ignored=IGNORED), what=what)
    return network.eval()


def import_length(state: StateDict) -> LengthEstimator:
    """The length estimator.

    Raises:
        ValueError: If weights are missing, unknown or misshapen.
    """
    what = "length estimator"
    first, last = (weight(state, f"output.{i}.weight", what=what) for i in (0, 11))
    network = LengthEstimator(LengthEstimatorConfig(text_dim=first.shape[1], classes=last.shape[0]))
    load_strictly(network, renamed(state, [(r"output\.(.+)", r"layers.\1")], ignored=IGNORED), what=what)
    return network.eval()


def trunk_sizes(state: StateDict, options: Options, *, what: str) -> dict[str, Any]:
    """Sizes of a transformer trunk with the text projection: fields of both transformers' configurations."""
    text = weight(state, "cond_emb.weight", what=what)
    feedforward = weight(state, "seqTransEncoder.layers.0.linear1.weight", what=what)
    return {
        "width": text.shape[0],
        "heads": number(options, "n_heads", 6),
        "layers": count_indices(state, r"seqTransEncoder\.layers\.(\d+)\."),
        "feedforward": feedforward.shape[0],
        "dropout": number(options, "dropout", 0.2),
        "text_dim": text.shape[1],
    }


def encoder_rules(published: str, stages: int, *, ours: str = "encoder") -> list[Rule]:
    """Rules for a convolutional encoder called ``published``."""
    rules = [
        (rf"{published}\.model\.0\.(.+)", rf"{ours}.entry.\1"),
        (rf"{published}\.model\.{2 + stages}\.(.+)", rf"{ours}.exit.\1"),
    ]
    for stage in range(stages):
        at = rf"{published}\.model\.{2 + stage}"
        rules.append((rf"{at}\.0\.(.+)", rf"{ours}.down.{stage}.\1"))
        rules += _stack_rules(rf"{at}\.1", f"{ours}.stacks.{stage}")
    return rules


def decoder_rules(stages: int) -> list[Rule]:
    """Rules for the convolutional decoder."""
    rules = [
        (r"decoder\.model\.0\.(.+)", r"decoder.entry.\1"),
        (rf"decoder\.model\.{2 + stages}\.(.+)", r"decoder.smooth.\1"),
        (rf"decoder\.model\.{4 + stages}\.(.+)", r"decoder.exit.\1"),
    ]
    for stage in range(stages):
        at = rf"decoder\.model\.{2 + stage}"
        rules += _stack_rules(rf"{at}\.0", f"decoder.stacks.{stage}")
        rules.append((rf"{at}\.2\.(.+)", rf"decoder.up.{stage}.\1"))
    return rules


def _stack_rules(published: str, ours: str) -> list[Rule]:
    return [
        (rf"{published}\.model\.(\d+)\.{theirs}\.(.+)", rf"{ours}.\1.{name}.\2")
        for theirs, name in _BLOCK.items()
    ]


def _book_rules(is_shared: bool) -> list[Rule]:
    if is_shared:  # every layer's name then stands for the one codebook
        return [(r"quantizer\.layers\.\d+\.codebook", "quantizer.books.0.codes")]
    return [(r"quantizer\.layers\.(\d+)\.codebook", r"quantizer.books.\1.codes")]


def codebook_state(network: nn.Module, weights: StateDict) -> StateDict:
    """Running sums that published files leave out: as after the first batch, so training can go on."""
    state: StateDict = {}
    for name, value in network.state_dict().items():
        codes = weights.get(name.rpartition(".")[0] + ".codes")
        if name.endswith(".ema_sum") and codes is not None:
            state[name] = codes.clone()
        elif name.endswith(".ema_count") or name.endswith(".is_initialized"):
            state[name] = torch.ones_like(value)
    return state


def _check_variant(options: Options, name: str, wanted: str) -> None:
    found = options.get(name, wanted)
    if found != wanted:
        raise ValueError(
            f"Option {name!r} of opt.txt is {found!r}; only the published {wanted!r} is supported."
        )
