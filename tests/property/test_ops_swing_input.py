"""What `swing_rotations` refuses, in either backend, and that it says what was wrong."""

import pytest
import torch

from controlmm import ops

CLIP = torch.ones(5, 4, 3, dtype=torch.float64)
ROTATIONS, HEADING = torch.ones(5, 3, 6, dtype=torch.float64), torch.ones(5, 4, dtype=torch.float64)
GOOD = {
    "rotations": ROTATIONS, "before": CLIP, "after": CLIP, "heading": HEADING, "chains": ((0, 1, 2), (0, 3)),
}  # fmt: skip
WRONG = [
    ("rotations", ROTATIONS.float(), TypeError, r"`rotations` must be float64, got torch\.float32"),
    ("before", CLIP.tolist(), TypeError, "`before` must be a float64 tensor, got list"),
    ("heading", None, TypeError, "`heading` must be a float64 tensor, got NoneType"),
    (
        "rotations",
        ROTATIONS[:, :2],
        ValueError,
        r"`rotations` must have shape \(5, 3, 6\) to fit `before`, got",
    ),
    ("rotations", ROTATIONS.flatten(1), ValueError, r"`rotations` must have shape .* got \(5, 18\)"),
    ("before", CLIP[0], ValueError, r"`before` must have shape \(T, J, 3\) with J >= 1, got \(4, 3\)"),
    ("before", CLIP[:, :0], ValueError, r"`before` must have shape \(T, J, 3\) with J >= 1, got \(5, 0, 3\)"),
    ("before", CLIP[..., :2], ValueError, "`before` must have shape"),
    ("after", CLIP[:4], ValueError, r"`after` must have shape \(5, 4, 3\) to fit `before`, got \(4, 4, 3\)"),
    (
        "heading",
        HEADING[:, :3],
        ValueError,
        r"`heading` must have shape \(5, 4\) to fit `before`, got \(5, 3\)",
    ),
    ("chains", (0, 1, 2, 3), TypeError, "`chains` must be sequences of joints, got 0 among them"),
    ("chains", ((0, 1, 2.0), (0, 3)), TypeError, r"`chains` must hold indices of joints, got 2\.0"),
    ("chains", ((0, 1, 2), (0, 4)), ValueError, r"`chains` must lie within \[0, 4\), got 4"),
    ("chains", ((-1, 0, 1, 2, 3),), ValueError, r"`chains` must lie within \[0, 4\), got -1"),
    ("chains", ((0, 1, 2, 3), (2**70,)), ValueError, r"`chains` must lie within \[0, 4\)"),
    ("chains", ((0, 2, 1), (0, 3)), ValueError, "from earlier joints to later ones, got 1 after 2"),
    ("chains", ((0, 1, 2, 3), (3, 0)), ValueError, "from earlier joints to later ones, got 0 after 3"),
    ("chains", ((0, 1, 2), (0, 3), (1, 3)), ValueError, "`chains` must lead to each joint once, got 3 again"),
    (
        "chains",
        ((0, 1),),
        ValueError,
        r"`chains` must lead to each of 4 joints but the first, got none to \[2, 3\]",
    ),
    ("chains", (), ValueError, r"got none to \[1, 2, 3\]"),
    ("backend", "fast", ValueError, "`backend` must be one of"),
]


@pytest.mark.parametrize("backend", ["auto", "reference"])
@pytest.mark.parametrize(("argument", "value", "error", "words"), WRONG)
def test_what_does_not_fit_is_refused(argument, value, error, words, backend):
    ops.swing_rotations(**GOOD, backend=backend)
    with pytest.raises(error, match=words):
        ops.swing_rotations(**{**GOOD, "backend": backend, argument: value})
