"""Logits that have seen where targets pull the codes: editing of logits for the price of a few evaluations.

The papers move logits by a hundred gradient steps in every decoding step. Here Gauss-Newton says where the
codes that logits expect should be, and that place counts as an observation of each token's code, with a
normal error. By Bayes' rule a code's logit then changes by its product with the way there: tokens change
where targets want them to, in favour of codes that the networks hold likely.
"""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from controlmm.generation.objective import ControlObjective
from controlmm.generation.one_thread import one_thread
from controlmm.generation.solvers import Stopping, gauss_newton
from controlmm.generation.token_mixture import token_mixture
from controlmm.nn.row_product import row_product

_TRUST = 8.0  # by which logits change for a way as long as that between two codes
_NEAR = 0.05  # metres from the targets at which nothing is left to be observed


def observed_logits(
    logits: Float[Tensor, "B L K"],
    objective: ControlObjective,
    codes: Float[Tensor, "K C"],
    keep: Float[Tensor, "B L 1"],
    *,
    steps: int,
) -> Float[Tensor, "B L K"]:
    """Logits after the observation; as they were where targets are met already.

    Nothing is observed of an objective that is no sum of squares: obstacles would be forgotten.

    Args:
        logits: Base-layer logits.
        objective: The targets; squared distances.
        codes: Base codebook.
        keep: 1 where a token may change.
        steps: Of Gauss-Newton.
    """
    residuals = objective.residuals()
    if residuals is None:
        return logits
    expected = row_product(token_mixture(logits), codes) * keep
    near = _NEAR / objective.decoder.normalizer.skeleton.metres
    found = gauss_newton(residuals, expected, keep, Stopping(error=near, iterations=steps))
    return logits + row_product((found.latents - expected) * _trust(codes), codes.T)


@one_thread()
def _trust(codes: Float[Tensor, "K C"]) -> float:
    """One over the variance of an observation's error: two codes lie twice the codebook's variance apart."""
    return _TRUST / (2 * codes.var(0).sum().item())
