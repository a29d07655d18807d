"""The tables of TLControl on a tiny model: their rows exist and mean what they say."""

from __future__ import annotations

from dataclasses import replace

import torch
from benchmarks import tlcontrol, tlcontrol_ablation

from controlmm.generation.motion_decoder import MotionDecoder


def test_errors_fall_and_nothing_is_hidden(tiny_tlcontrol, tiny_data_folder):
    batches = tlcontrol.read_clips(tiny_tlcontrol.skeleton, tiny_data_folder, split="val", limit=3)
    assert [len(clips.lengths) for clips in batches] == [3]
    assert batches[0].lengths == [68, 68, 72]  # 70 to 75 frames, whole tokens

    preset = replace(tlcontrol._PRESET, iterations=20)
    wrists = tlcontrol.JOINT_SETS["both hands"]
    measured = tlcontrol.measure(
        tiny_tlcontrol, batches, preset, lambda clips: clips.mask(wrists, tiny_tlcontrol.skeleton)
    )
    assert measured.average < measured.feedforward
    assert 1 < measured.evaluations <= 25
    assert measured.seconds > 0


def test_masks_hold_the_named_joints_of_every_clip(tiny_tlcontrol, tiny_data_folder):
    (clips,) = tlcontrol.read_clips(tiny_tlcontrol.skeleton, tiny_data_folder, split="val", limit=3)
    mask = clips.mask(("head", "left_foot"), tiny_tlcontrol.skeleton)
    assert mask.any(1)[0].nonzero()[:, 0].tolist() == [10, 15]
    assert mask.sum((1, 2)).tolist() == [136, 136, 144]


def test_the_ablation_measures_a_tokenizer_alone(tiny_tlcontrol, tiny_data_folder):
    batches = tlcontrol.read_clips(tiny_tlcontrol.skeleton, tiny_data_folder, split="val", limit=2)
    decoder = MotionDecoder(tiny_tlcontrol.tokenizer, tiny_tlcontrol.decoder.normalizer)
    assert tlcontrol_ablation.reconstruction_error(decoder, batches) > 0
    mask = batches[0].mask(("pelvis",), tiny_tlcontrol.skeleton)
    errors, evaluations, seconds = tlcontrol_ablation.control(
        decoder, tiny_tlcontrol.tokenizer, batches[0], mask
    )
    assert torch.tensor(errors).max() < 0.2  # the pelvis alone is easily met, whatever the weights
    assert min(evaluations) > 1
    assert seconds > 0


def test_tables_are_markdown():
    assert tlcontrol.markdown([("a", "b"), ("1", "2")]) == "| a | b |\n| --- | --- |\n| 1 | 2 |"
