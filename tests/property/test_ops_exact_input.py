"""What the operators of the closed end refuse, in either backend, and that they say what was wrong."""

import pytest
import torch

from controlmm import ops

PARENTS = (-1, 0, 1, 0)
CLIP = torch.zeros(5, 4, 3, dtype=torch.float64)
HELD, PLANTED, LENGTHS = CLIP.bool(), CLIP[..., 0].bool(), CLIP[0, :, 0] + 1
BODY = {"held": HELD, "planted": PLANTED, "parents": PARENTS}
EFFORT = {"feet": (2,), "enough": 1e-3, "steps": 2}
GOOD = {
    "project_change": {"change": CLIP, **BODY},
    "smooth_bones": {"joints": CLIP, "lengths": LENGTHS, **BODY, **EFFORT, "toes": (2,)},
    "frame_bones": {"joints": CLIP, "lengths": LENGTHS, **BODY, **EFFORT, "metre": 1.0},
}
WRONG = [  # argument, value, error, its words; where "clip" is the tensor that each operator moves
    ("clip", CLIP.float(), TypeError, r"must be float64, got torch\.float32"),
    ("clip", CLIP.tolist(), TypeError, "must be a float64 tensor, got list"),
    ("clip", CLIP[0], ValueError, r"must have shape \(T, 4, 3\), got \(4, 3\)"),
    ("clip", CLIP[:, :3], ValueError, r"must have shape \(T, 4, 3\), got \(5, 3, 3\)"),
    ("held", CLIP, ValueError, r"`held` must be boolean of shape \(5, 4, 3\), got torch\.float64"),
    ("held", HELD[..., 0], ValueError, r"`held` must be boolean of shape .*got torch\.bool of \(5, 4\)"),
    ("held", None, TypeError, "`held` must be a boolean tensor, got NoneType"),
    ("planted", PLANTED[1:], ValueError, r"`planted` must be boolean of shape \(5, 4\)"),
    ("parents", (), ValueError, "`parents` must be -1 for the first joint"),
    ("parents", (0, 0, 1, 0), ValueError, "`parents` must be -1 for the first joint"),
    ("parents", (-1, 0, 2, 0), ValueError, "name an earlier joint for every other"),
    ("parents", (-1, 0, -1, 0), ValueError, "name an earlier joint for every other"),
    ("parents", (-1, 0, -2, 0), ValueError, "name an earlier joint for every other"),
    ("parents", (-1, 0, 2**70, 0), ValueError, "name an earlier joint for every other"),
    ("parents", (-1, 0, 1.0, 0), TypeError, "`parents` must be whole numbers"),
    ("parents", (-1, 0, 1), ValueError, r"must have shape \(T, 3, 3\)"),
    ("lengths", LENGTHS[1:], ValueError, r"`lengths` must have shape \(4,\), got \(3,\)"),
    ("lengths", LENGTHS.float(), TypeError, "`lengths` must be float64"),
    ("feet", (4,), ValueError, r"`feet` must lie within \[0, 4\), got 4"),
    ("feet", (-1,), ValueError, r"`feet` must lie within \[0, 4\), got -1"),
    ("feet", (0.5,), TypeError, r"`feet` must be indices of joints, got 0\.5"),
    ("toes", (2**40,), ValueError, "`toes` must lie within"),
    ("enough", 0.0, ValueError, "`enough` must be a positive length, got 0"),
    ("enough", float("nan"), ValueError, "`enough` must be a positive length, got nan"),
    ("metre", -1.0, ValueError, r"`metre` must be a positive length, got -1\.0"),
    ("steps", -2, ValueError, "`steps` must not be negative, got -2"),
    ("steps", 2.0, TypeError, "`steps` must be a whole number, got float"),
    ("backend", "fast", ValueError, "`backend` must be one of"),
]


def refusals():
    for name, good in GOOD.items():
        for argument, value, error, words in WRONG:
            known = next(iter(good)) if argument == "clip" else argument
            if known in good or known == "backend":
                yield pytest.param(name, known, value, error, words, id=f"{name}-{known}-{words[-20:]}")


@pytest.mark.parametrize("backend", ["auto", "reference"])
@pytest.mark.parametrize(("name", "argument", "value", "error", "words"), list(refusals()))
def test_what_does_not_fit_is_refused(name, argument, value, error, words, backend):
    getattr(ops, name)(**GOOD[name], backend=backend)
    with pytest.raises(error, match=words):
        getattr(ops, name)(**{**GOOD[name], "backend": backend, argument: value})


def test_an_odd_number_of_steps_of_a_frame_is_refused():
    with pytest.raises(ValueError, match="`steps` must be even"):
        ops.frame_bones(**{**GOOD["frame_bones"], "steps": 3})
    ops.smooth_bones(**{**GOOD["smooth_bones"], "steps": 3})


@pytest.mark.parametrize("name", GOOD)
def test_no_step_and_nothing_wrong_change_nothing(name):
    still = {**GOOD[name], "steps": 0} if "steps" in GOOD[name] else GOOD[name]
    assert not getattr(ops, name)(**still).any()
