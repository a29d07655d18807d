"""Everything that is measured on one batch, a row a sample, kept in a file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from controlmm.data.clip import Caption
from controlmm.evaluation.control_errors import control_errors
from controlmm.evaluation.evaluators import Evaluator
from controlmm.evaluation.motion_sources import Batch, Produced
from controlmm.evaluation.plausibility import (
    bone_length_deviation,
    contact_consistency,
    floor_penetration,
    mean_jerk,
)
from controlmm.evaluation.reconstruction import root_aligned_error
from controlmm.evaluation.skating import foot_skating_ratio, published_skating_ratio
from controlmm.io.atomic import replaced_on_success
from controlmm.motion.skeleton import skeleton_of_width
from controlmm.ops import recover_joints

_METRES = {"m": 1.0, "mm": 0.001}


@dataclass(frozen=True, eq=False)
class BatchScores:
    """Embeddings (B, E) and numbers (B,) of the samples of a batch.

    Attributes:
        texts: Embeddings of the captions.
        real: Of the recordings.
        motions: Of the evaluated motions.
        numbers: Metrics that are a number a sample; NaN where one does not apply.
    """

    texts: Float[Tensor, "B E"]
    real: Float[Tensor, "B E"]
    motions: Float[Tensor, "B E"]
    numbers: dict[str, Float[Tensor, "B"]]

    def save(self, path: Path) -> None:
        """Write a file that is whole or not there."""
        path.parent.mkdir(parents=True, exist_ok=True)
        embeddings = {"texts": self.texts, "real": self.real, "motions": self.motions}
        tensors = embeddings | {f"number.{name}": value for name, value in self.numbers.items()}
        with replaced_on_success(path) as partial:
            save_file({name: tensor.contiguous() for name, tensor in tensors.items()}, partial)

    @classmethod
    def load(cls, path: Path) -> BatchScores | None:
        """What :meth:`save` wrote; ``None`` if the file is missing or damaged, so that it is made again."""
        if not path.is_file():
            return None
        try:
            tensors = load_file(path)
            numbers = {
                name.removeprefix("number."): value
                for name, value in tensors.items()
                if name.startswith("number.")
            }
            return cls(tensors["texts"], tensors["real"], tensors["motions"], numbers)
        except (SafetensorError, KeyError):
            return None


@torch.no_grad()
def score_batch(
    batch: Batch, produced: Produced, evaluator: Evaluator, *, mask_padding: bool = False
) -> BatchScores:
    """Measure a batch.

    Args:
        batch: Captions, recordings and targets.
        produced: The motions to judge.
        evaluator: Makes the embeddings.
        mask_padding: Hide what a decoder wrote beyond the clips from the evaluator. The published evaluation
            does not.
    """
    lengths = batch.lengths
    captions: list[Caption] = [sample.caption for sample in batch.samples]
    sees_padding = produced.has_padding and not mask_padding
    return BatchScores(
        texts=evaluator.embed_captions(captions),
        real=evaluator.embed_motions(batch.real, lengths),
        motions=evaluator.embed_motions(produced.features, lengths, sees_padding=sees_padding),
        numbers={**_numbers(batch, produced), **produced.numbers},
    )


def _numbers(batch: Batch, produced: Produced) -> dict[str, Tensor]:
    lengths, skeleton = batch.lengths, skeleton_of_width(produced.features.shape[-1])
    metres = _METRES[skeleton.unit]
    joints = recover_joints(produced.features, joints=skeleton.num_joints)
    whole = (
        published_skating_ratio(joints, skeleton=skeleton) if produced.has_padding else lengths * torch.nan
    )
    numbers = {
        "skating": foot_skating_ratio(joints, lengths=lengths, skeleton=skeleton),
        "skating_published": whole,
        "penetration": metres * floor_penetration(joints, lengths=lengths),
        "jerk": metres * mean_jerk(joints, lengths=lengths, fps=skeleton.fps),
        "bone_deviation": metres * bone_length_deviation(joints, lengths=lengths, skeleton=skeleton),
        "contact_consistency": contact_consistency(produced.features, joints, lengths=lengths),
        "distance_to_real": metres * root_aligned_error(joints, batch.joints, lengths=lengths),
        "seconds": torch.full((len(lengths),), produced.seconds / len(lengths)),
        "frames": lengths,
        "keys": batch.mask.flatten(1).sum(1),
    }
    for rule in ("joint", "frame"):
        errors = control_errors(metres * joints, metres * batch.joints, batch.mask, rule=rule)
        for threshold, values in errors.trajectory.items():
            numbers[f"trajectory_{_centimetres(threshold)}_{rule}"] = values
        for threshold, values in errors.location.items():
            numbers[f"location_{_centimetres(threshold)}_{rule}"] = values
        numbers[f"average_{rule}"] = errors.average
    for joint in skeleton.control_joints:
        alone = torch.zeros_like(batch.mask)
        alone[..., joint] = batch.mask[..., joint]
        errors = control_errors(metres * joints, metres * batch.joints, alone)
        numbers[f"average_of_{skeleton.joint_names[joint]}"] = errors.average
    return {name: value.float() for name, value in numbers.items()}


def _centimetres(threshold: float) -> str:
    return f"{round(100 * threshold)}"
