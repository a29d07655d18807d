"""Logits that have seen where targets pull the codes: editing of logits for the price of an evaluation.

The papers move logits by a hundred gradient steps in every decoding step. Here a target counts as an
observation, with a normal error, of the motion that the tokens decode to. Say that latents are normal about
the codes that logits expect, with the codes' own covariance: then the latents that are likeliest after the
observation lie a Gauss-Newton step away, and by Bayes' rule a code's logit changes by its product with the
force that makes that step. Tokens change where targets want them to, in favour of codes that the networks
hold likely.
"""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from controlmm.generation.control_residuals import ControlResiduals, Probe
from controlmm.generation.one_thread import one_thread
from controlmm.generation.solvers.metric import Metric
from controlmm.generation.token_mixture import token_mixture
from controlmm.nn.row_product import row_product

_NEAR = 0.05  # metres from the targets at which nothing is left to be observed


def observed_logits(
    logits: Float[Tensor, "B L K"],
    residuals: ControlResiduals,
    codes: Float[Tensor, "K C"],
    keep: Float[Tensor, "B L 1"],
) -> Float[Tensor, "B L K"]:
    """Logits after the observation; as they were where targets are met already.

    Args:
        logits: Base-layer logits.
        residuals: What should vanish.
        codes: Base codebook.
        keep: 1 where a token may change.
    """
    expected = row_product(token_mixture(logits), codes)
    forces = [_force(residuals, probe) for probe in residuals.probe(expected)]
    if all(force is None for force in forces):
        return logits
    return logits - row_product(residuals.pull(forces) * keep, codes.T)


@one_thread()
def _force(residuals: ControlResiduals, probe: Probe) -> Float[Tensor, "N"] | None:
    """On each coordinate of a clip: ``(J J^T + error)^-1 r``; ``None`` near the targets."""
    if probe.metres * (3 * probe.loss) ** 0.5 < _NEAR:
        return None
    return Metric(residuals.gram(probe), probe.view.groups).weigh(probe.residual)[1]
