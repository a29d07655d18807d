"""Options of training that make no sense are refused before anything runs."""

from __future__ import annotations

import pytest

from controlmm.training.control import ControlOptions
from controlmm.training.masked import MaskedOptions
from controlmm.training.rvq import RvqOptions


@pytest.mark.parametrize(
    ("options", "changes", "message"),
    [
        (ControlOptions, {"masks": "all"}, r"`masks` must be one of .*, got 'all'"),
        (ControlOptions, {"sampling": "hard"}, r"`sampling` must be one of .*, got 'hard'"),
        (ControlOptions, {"norm": "huber"}, r"`norm` must be one of .*, got 'huber'"),
        (ControlOptions, {"finer_layers": "some"}, r"`finer_layers` must be one of .*, got 'some'"),
        (MaskedOptions, {"loss_on": "some"}, r"`loss_on` must be 'all' or 'chosen', got 'some'"),
        (ControlOptions, {"alpha": 1.5}, r"`alpha` must be in \[0, 1\], got 1\.5"),
        (ControlOptions, {"drawn_share": -0.1}, r"`drawn_share` must be in \[0, 1\], got -0\.1"),
        (ControlOptions, {"share_of": 0}, r"`share_of` must be at least 1"),
        (MaskedOptions, {"embed_loss_weight": 2.0}, r"`embed_loss_weight` must be in \[0, 1\]"),
        (MaskedOptions, {"logit_noise_std": -1.0}, r"`logit_noise_std` not negative"),
        (MaskedOptions, {"share_of": 0}, r"`share_of` must be at least 1"),
        (RvqOptions, {"root_contact_bias": 0.0}, r"`root_contact_bias` must be positive"),
    ],
)
def test_impossible_options_are_refused(options, changes, message):
    with pytest.raises(ValueError, match=message):
        options(**changes)
