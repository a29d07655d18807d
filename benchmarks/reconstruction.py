"""Reconstruction error of a motion tokenizer on a split: all clips, and clips of the full 196 frames.

python -m benchmarks.reconstruction --data DATA [--model FOLDER] [--split test]
"""

import argparse
from pathlib import Path

import torch

from controlmm import ControlMM
from controlmm.data import FeatureClip, MotionFolder
from controlmm.generation.motion_decoder import MotionDecoder
from controlmm.ops import recover_joints

_FULL_LENGTH = 196


@torch.no_grad()
def joint_errors(decoder: MotionDecoder, clip: FeatureClip) -> tuple[float, float, float]:
    """Mean joint error of a clip in metres: global, relative to the root, and that in the heading frame."""
    frames = min(len(clip.features), _FULL_LENGTH) // decoder.downsample * decoder.downsample
    joints = decoder.normalizer.skeleton.num_joints
    features = clip.features[None, :frames]
    decoded = decoder.normalizer.denormalize(
        decoder.tokenizer.decode_ids(decoder.tokenizer.encode(decoder.normalizer.normalize(features)))
    )
    truth, rebuilt = recover_joints(features, joints=joints), recover_joints(decoded, joints=joints)
    relative = (rebuilt - rebuilt[:, :, :1]) - (truth - truth[:, :, :1])
    local = (decoded - features)[..., 4 : 4 + 3 * (joints - 1)].unflatten(-1, (-1, 3))
    return tuple(x.norm(dim=-1).mean().item() for x in (rebuilt - truth, relative, local))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True, help="HumanML3D-style folder")
    parser.add_argument("--model", type=Path, help="model folder; by default the one that ships")
    parser.add_argument("--split", default="test")
    arguments = parser.parse_args()
    decoder = ControlMM.from_pretrained(arguments.model).decoder
    clips = list(MotionFolder(arguments.data).clips(arguments.split, progress=True))
    titles = ("number", "global (cm)", "root-relative (cm)", "heading frame (cm)")
    print(f"{'clips':>16} {titles[0]:>7} {titles[1]:>12} {titles[2]:>19} {titles[3]:>19}")
    for title, shortest in (("all", decoder.downsample), (f"{_FULL_LENGTH} frames", _FULL_LENGTH)):
        chosen = [clip for clip in clips if len(clip.features) >= shortest]
        errors = 100 * torch.tensor([joint_errors(decoder, clip) for clip in chosen]).mean(0)
        print(f"{title:>16} {len(chosen):7} {errors[0]:12.2f} {errors[1]:19.2f} {errors[2]:19.2f}")


if __name__ == "__main__":
    main()
