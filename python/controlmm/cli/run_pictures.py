"""Pictures of a run in training: its curves so far, and what the network makes of a few clips."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from controlmm.training.stages import Validation

CURVES_FILE, SAMPLES_FOLDER = "curves.png", "samples"


def draw_validation(validation: Validation) -> None:
    """Refresh ``curves.png`` and add ``samples/step_NNNNNN.png`` in the run folder."""
    from controlmm.motion.motion import Motion
    from controlmm.training.run_folder import RunFolder
    from controlmm.viewer.sample_sheet import save_sample_sheet
    from controlmm.viewer.training_curves import save_training_curves

    run = validation.run
    save_training_curves(RunFolder(run).records(), run / CURVES_FILE, title=str(run))
    samples = validation.samples()
    if not samples:
        return
    pairs = [(s.title, Motion(joints=s.recorded), Motion(joints=s.made)) for s in samples]
    title = f"{run.name}, step {validation.step}"
    save_sample_sheet(pairs, run / SAMPLES_FOLDER / f"step_{validation.step:06d}.png", title=title)
