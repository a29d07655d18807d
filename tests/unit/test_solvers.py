"""AdamW and L-BFGS: known minima, stopping, PyTorch's optimisers as outside truth, independence of clips."""

from __future__ import annotations

import pytest
import torch

from controlmm.generation.objective import ControlObjective
from controlmm.generation.solvers import LbfgsTolerance, Stopping, adamw, lbfgs
from controlmm.generation.solvers.stopping import Watch
from controlmm.models.rvq_vae import frame_mask
from controlmm.ops import masked_consistency_loss

ROUNDING = 1e-5  # of float32 gradients through the decoder in another order
TORCH_PATH = 1e-6  # same algorithm; sums of vectors are taken in another order


def random(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


class Bowl:
    """0.5 sum_i stiffness_i (x_i - target_i)^2 for each clip; remembers what it was asked."""

    def __init__(self, target, stiffness=None, asked=None):
        self.target = target
        self.stiffness = torch.ones_like(target) if stiffness is None else stiffness
        self.asked = [] if asked is None else asked
        self.latest = torch.zeros(len(target))

    def value_and_gradient(self, latents):
        self.asked.append(latents.clone())
        difference = latents - self.target
        self.latest = difference.flatten(1).norm(dim=1)
        return (
            0.5 * (self.stiffness * difference.square()).sum((1, 2)),
            self.stiffness * difference,
        )

    def select(self, clips):
        return Bowl(self.target[clips], self.stiffness[clips], self.asked)

    def errors(self):
        return self.latest


class Rosenbrock:
    """The banana valley in the two channels of every clip's only token."""

    def value_and_gradient(self, latents):
        with torch.enable_grad():
            x = latents.detach().requires_grad_()
            first, second = x[:, 0, 0], x[:, 0, 1]
            loss = (1 - first).square() + 100 * (second - first.square()).square()
            (gradient,) = torch.autograd.grad(loss.sum(), x)
        return loss.detach(), gradient

    def select(self, clips):
        return self


def everywhere(latents: torch.Tensor) -> torch.Tensor:
    return torch.ones(*latents.shape[:2], 1)


@pytest.mark.parametrize("decays_rate", [True, False])
def test_adamw_reaches_the_minimum_of_a_quadratic(decays_rate):
    target = random(2, 3, 4)
    bowl = Bowl(target)
    start = torch.zeros(2, 3, 4)
    solution = adamw(bowl, start, everywhere(start), Stopping(iterations=300), decays_rate=decays_rate)
    torch.testing.assert_close(solution.latents, target, rtol=0, atol=0.02)
    torch.testing.assert_close(solution.losses[0][0], 0.5 * target[0].square().sum())
    assert (solution.evaluations <= 301).all()


def test_adamw_takes_the_steps_of_torchs_adamw():
    start, bowl = random(2, 3, 4), Bowl(random(2, 3, 4, seed=1), random(2, 3, 4, seed=2).square())
    variable = start.clone().requires_grad_()
    optimizer = torch.optim.AdamW([variable], lr=0.06, betas=(0.5, 0.9), weight_decay=1e-6)
    for _ in range(20):
        variable.grad = bowl.value_and_gradient(variable.detach())[1]
        optimizer.step()
    solution = adamw(bowl, start, everywhere(start), Stopping(iterations=20))
    torch.testing.assert_close(bowl.asked[-1], variable.detach(), rtol=1e-6, atol=1e-6)
    assert solution.reasons == ("iterations", "iterations")


def test_every_clip_keeps_its_best_iterate():
    class Scripted:
        values = iter(torch.tensor([[5.0, 5.0], [1.0, 4.0], [9.0, 2.0], [7.0, 3.0]]))

        def __init__(self):
            self.seen = []

        def value_and_gradient(self, latents):
            self.seen.append(latents.clone())
            return next(self.values), torch.ones_like(latents)

        def select(self, clips):
            raise AssertionError("all clips run to the end")

    objective, start = Scripted(), random(2, 3, 4)
    solution = adamw(objective, start, everywhere(start), Stopping(iterations=3))
    assert torch.equal(solution.latents[0], objective.seen[1][0])
    assert torch.equal(solution.latents[1], objective.seen[2][1])
    assert [losses.min().item() for losses in solution.losses] == [1.0, 2.0]


def test_no_iterations_judge_the_start_and_change_nothing():
    start = random(1, 3, 4)
    bowl = Bowl(torch.zeros(1, 3, 4))
    solution = adamw(bowl, start, everywhere(start), Stopping(iterations=0))
    assert torch.equal(solution.latents, start)
    assert solution.evaluations.tolist() == [1]


@pytest.mark.parametrize("solver", [adamw, lbfgs])
def test_a_clip_that_meets_its_target_leaves_the_batch(solver):
    start = torch.zeros(3, 2, 2)
    start[1] += 5.0
    bowl = Bowl(torch.zeros(3, 2, 2), random(3, 2, 2).square() + 0.1)
    solution = solver(bowl, start, everywhere(start), Stopping(iterations=400, error=1e-3))
    assert solution.evaluations[[0, 2]].tolist() == [1, 1]
    assert solution.evaluations[1] > 3
    assert [len(asked) for asked in bowl.asked] == [3] + [1] * (int(solution.evaluations[1]) - 1)
    assert solution.reasons == ("target met", "target met", "target met")
    assert solution.errors[1][-1] <= 1e-3 < solution.errors[1][:-1].min()


@pytest.mark.parametrize("solver", [adamw, lbfgs])
def test_fixed_tokens_are_not_edited(solver):
    keep = torch.tensor([[0.0], [1.0], [0.0]])[None]
    start = torch.zeros(1, 3, 4)
    solution = solver(Bowl(torch.ones(1, 3, 4)), start, keep, Stopping(iterations=30))
    assert solution.latents[0, [0, 2]].abs().max() == 0
    assert solution.latents[0, 1].min() > 0.9


@pytest.mark.parametrize("solver", [adamw, lbfgs])
def test_evaluations_can_be_limited(solver):
    start = random(2, 3, 4)
    bowl = Bowl(torch.zeros(2, 3, 4), random(2, 3, 4, seed=3).square() + 0.01)
    solution = solver(bowl, start, everywhere(start), Stopping(iterations=100, evaluations=4))
    assert solution.evaluations.tolist() == [4, 4]
    assert solution.reasons == ("evaluations", "evaluations")


def test_lbfgs_finds_the_end_of_the_banana_valley():
    start = torch.tensor([[[-1.2, 1.0]], [[0.0, 3.0]]])
    solution = lbfgs(Rosenbrock(), start, everywhere(start), Stopping(iterations=100))
    torch.testing.assert_close(solution.latents, torch.ones(2, 1, 2), rtol=0, atol=1e-3)
    assert (solution.evaluations < 60).all()


@pytest.mark.parametrize("rate", [1.0, 0.1])
@pytest.mark.parametrize("change", [1e-5, 1e-9])
def test_lbfgs_walks_the_path_of_torchs_lbfgs(rate, change):
    start = torch.tensor([[[-1.2, 1.0]]], dtype=torch.float64)  # float32 rounding would part the ways
    path = []
    variable = start.clone().requires_grad_()
    optimizer = torch.optim.LBFGS(
        [variable],
        lr=rate,
        max_iter=25,
        max_eval=1000,
        history_size=200,
        tolerance_change=change,
        line_search_fn="strong_wolfe",
    )

    def closure():
        loss, gradient = Rosenbrock().value_and_gradient(variable)
        path.append(loss.item())
        variable.grad = gradient
        return loss.sum()

    optimizer.step(closure)
    solution = lbfgs(
        Rosenbrock(),
        start,
        everywhere(start),
        Stopping(iterations=25),
        rate=rate,
        tolerance=LbfgsTolerance(change=change),
    )
    assert len(solution.losses[0]) == len(path)
    torch.testing.assert_close(solution.losses[0], torch.tensor(path), rtol=TORCH_PATH, atol=TORCH_PATH)
    torch.testing.assert_close(solution.latents, variable.detach(), rtol=TORCH_PATH, atol=TORCH_PATH)


def test_lbfgs_stops_where_the_gradient_vanishes():
    start = torch.zeros(1, 2, 2)
    bowl = Bowl(torch.full((1, 2, 2), 1e-9))
    assert lbfgs(bowl, start, everywhere(start), Stopping(iterations=9)).reasons == ("converged",)


def test_lbfgs_sets_out_on_a_bowl_so_flat_that_its_usual_first_trial_drowns_in_rounding():
    """By PyTorch's rule that trial changes the loss by 2e-8 of itself, less than float32 can tell."""
    start = torch.zeros(1, 4, 8)
    bowl = Bowl(1 + random(1, 4, 8).abs(), 1e-8 * (1 + random(1, 4, 8, seed=1).abs()))
    call = (bowl, start, everywhere(start), Stopping(iterations=40))
    endless = LbfgsTolerance(gradient=0.0, change=1e-30)
    stuck = lbfgs(*call, tolerance=endless)
    assert stuck.reasons == ("converged",)
    assert stuck.losses[0].min() > 0.99 * stuck.losses[0][0]
    found = lbfgs(*call, tolerance=endless, first_reach=0.1)
    assert found.losses[0].min() < 1e-6 * found.losses[0][0]


def test_a_clips_lbfgs_does_not_depend_on_the_clips_beside_it():
    """Bitwise, since the objective's numbers do not: every clip has its own line search and memory."""
    start = torch.cat([torch.tensor([[[-1.2, 1.0]]]), 3 * random(4, 1, 2)])
    together = lbfgs(Rosenbrock(), start, everywhere(start), Stopping(iterations=40))
    for clip in range(len(start)):
        alone = lbfgs(Rosenbrock(), start[clip : clip + 1], everywhere(start[:1]), Stopping(iterations=40))
        assert torch.equal(alone.latents[0], together.latents[clip])
        assert torch.equal(alone.losses[0], together.losses[clip])


def test_a_budget_in_milliseconds_ends_the_search():
    times = iter([0.0, 0.0, 0.004, 0.006])
    watch = Watch(Stopping(milliseconds=5), clock=lambda: next(times))
    assert watch.verdict(loss=1.0, error=None, evaluations=1) is None
    assert watch.verdict(loss=1.0, error=None, evaluations=2) is None
    assert watch.verdict(loss=1.0, error=None, evaluations=3) == "time"


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        ({"error": 0.0, "iterations": 1}, "`error` must be a positive number"),
        ({"milliseconds": float("nan")}, "`milliseconds` must be a positive number"),
        ({"iterations": -1}, "`iterations` must be at least 0"),
        ({"evaluations": 0}, "`evaluations` must be at least 1"),
        ({"error": 0.01}, "A solver needs a limit that it always reaches"),
    ],
)
def test_unusable_limits_are_refused(limits, message):
    with pytest.raises(ValueError, match=message):
        Stopping(**limits)


def test_adamw_must_know_how_many_iterations():
    start = torch.zeros(1, 1, 1)
    with pytest.raises(ValueError, match=r"`adamw` needs `stopping.iterations`"):
        adamw(Bowl(start), start, everywhere(start), Stopping(evaluations=3))


@pytest.mark.parametrize("solver", [adamw, lbfgs])
def test_an_empty_batch_has_an_empty_solution(solver):
    start = torch.zeros(0, 3, 4)
    solution = solver(Bowl(start), start, everywhere(start), Stopping(iterations=3))
    assert solution.latents.shape == (0, 3, 4)
    assert solution.reasons == ()


@pytest.mark.parametrize("solver", [adamw, lbfgs])
def test_solvers_lower_the_error_of_the_decoded_motion(solver, tiny_pipeline):
    decoder = tiny_pipeline.decoder
    frames = frame_mask(torch.tensor([24, 16]), 24)
    targets = random(2, 24, 22, 3, seed=1)
    mask = torch.rand(2, 24, 22, 3, generator=torch.Generator().manual_seed(2)) < 0.05
    mask &= frames[..., None, None]
    keep = frames[:, ::4, None].float()
    start = decoder.tokenizer.base_codes[:6].expand(2, 6, 16) * keep
    objective = ControlObjective(decoder, targets, mask, frames)
    solution = solver(objective, start, keep, Stopping(iterations=40))
    final = masked_consistency_loss(
        decoder(solution.latents, frames), targets, mask, norm="mse", reduction="clip"
    )
    for clip in range(2):
        assert final[clip] < 0.9 * solution.losses[clip][0]
        torch.testing.assert_close(final[clip], solution.losses[clip].min(), rtol=1e-4, atol=ROUNDING)
