"""Groups of clips that networks take together: every clip once, none too large, and where the clips lie."""

from __future__ import annotations

import torch

from controlmm.generation.clip_groups import clips_end_to_end, clips_of_like_length


def test_every_clip_lies_in_one_group_of_at_most_sixteen_long_clips():
    lengths = torch.randint(2, 50, (70,), generator=torch.Generator().manual_seed(0)).tolist()
    groups = clips_end_to_end(lengths, padded=49, step=4)
    assert [clip for group in groups for clip in group.clips] == list(range(70))
    assert [length for group in groups for length in group.lengths] == lengths
    assert max(sum(group.lengths) for group in groups) <= 16 * 49
    assert [group.clips for group in clips_end_to_end([49] * 17, padded=49, step=4)] == [
        tuple(range(16)),
        (16,),
    ]
    (longer,) = clips_end_to_end([500], padded=500, step=4)
    assert longer.lengths == (500,)
    assert clips_end_to_end([], padded=0, step=4) == []


def test_clips_of_like_length_waste_little_on_padding():
    lengths = torch.randint(2, 50, (70,), generator=torch.Generator().manual_seed(0)).tolist()
    groups = [group.tolist() for group in clips_of_like_length(lengths)]
    assert sorted(clip for group in groups for clip in group) == list(range(70))
    sizes = [len(group) * max(lengths[clip] for clip in group) for group in groups]
    assert max(sizes) <= 16 * 49
    assert sum(sizes) < 1.25 * sum(lengths)
    assert len(groups) < 6  # small ones cost more than padding
    assert sorted(len(group) for group in clips_of_like_length([49] * 17)) == [1, 16]


def test_places_are_those_in_the_flattened_batch():
    lengths, padded, step = [2, 3, 1], 3, 4
    (group,) = clips_end_to_end(lengths, padded=padded, step=step)
    for places, count in ((group.tokens, 1), (group.frames, step)):
        batch = torch.arange(3 * padded * count).view(3, -1)
        expected = [clip[: length * count] for clip, length in zip(batch, lengths, strict=True)]
        assert torch.equal(batch.flatten()[places], torch.cat(expected))
