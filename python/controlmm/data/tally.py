"""What of a folder of clips training will use, counted while the clips pass."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator

from controlmm.data.clip import FEWEST_FRAMES, MOST_FRAMES, SPLITS, Clip
from controlmm.motion.skeleton import KIT


class Tally:
    """Counts clips by split, and those that some stage of training leaves out."""

    def __init__(self) -> None:
        self.clips: Counter[str] = Counter()  # by split
        self.without_caption = 0
        self.of_odd_length = 0

    def counted(self, clips: Iterable[Clip]) -> Iterator[Clip]:
        """The same clips, each counted as it passes."""
        for clip in clips:
            self.clips[clip.split] += 1
            self.without_caption += not clip.captions
            unit = "mm" if clip.joints.shape[1] == KIT.num_joints else "m"
            frames = len(clip.joints) - 1  # of its features, which hold velocities
            self.of_odd_length += not FEWEST_FRAMES[unit] <= frames <= MOST_FRAMES
            yield clip

    def splits(self) -> str:
        """How many clips each split has, in words."""
        return ", ".join(f"{split} {self.clips[split]}" for split in SPLITS)

    def cautions(self) -> list[str]:
        """What the clips cannot be used for; empty when there is nothing to say."""
        said = []
        if not self.clips["val"]:
            said.append(
                "No clip is for validation, and training needs some: list names, one a line, in val.txt (and "
                "test.txt) beside the joints, or give packs the split val, and prepare again."
            )
        if self.without_caption:
            said.append(
                f"{self.without_caption} of {self.clips.total()} clips have no caption: only the tokenizer "
                "is trained on them."
            )
        if self.of_odd_length:
            said.append(
                f"{self.of_odd_length} of {self.clips.total()} clips do not have {FEWEST_FRAMES['m']} to "
                f"{MOST_FRAMES} frames (KIT-ML: from {FEWEST_FRAMES['mm']}): only the tokenizer is trained "
                "on them. Cut long ones into pieces."
            )
        return said
