"""The moving figure as ``.gif`` (Pillow) or ``.mp4`` (PyAV, extra ``video``)."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path
from typing import Any

from numpy import ndarray
from PIL import Image
from tqdm import tqdm

from controlmm.io.atomic import replaced_on_success
from controlmm.motion.motion import Motion
from controlmm.viewer.moving_picture import MovingPicture
from controlmm.viewer.scene import scene_of

_GIF_COLORS = 64
_VIDEO_CODECS = ("libx264", "libopenh264", "mpeg4")  # the first that the installed PyAV can encode


class GifFormat:
    """Writer of ``.gif``."""

    @staticmethod
    def save(
        motion: Motion,
        path: Path,
        *,
        targets: Any = None,
        mask: Any = None,
        title: str | None = None,
        size: tuple[int, int] = (640, 520),
        follow: bool = False,
        progress: bool = False,
    ) -> None:
        """Write the figure with its targets and trails, at the motion's frame rate, repeating.

        Args:
            motion: The motion to show.
            path: File to write, replaced as a whole.
            targets: (T, J, 3) control targets in the skeleton's unit; ``None``: ``motion.extra["targets"]``.
            mask: (T, J, 3) bool, the coordinates asked for; ``None`` takes ``motion.extra["mask"]``.
            title: Line above the picture; ``None`` takes the motion's text.
            size: Width and height in pixels, even, 160 to 2048.
            follow: Keep the camera on the pelvis instead of on the whole way.
            progress: Show a progress bar.

        Raises:
            ValueError: If the size is odd or out of range, or targets and mask do not fit the motion.
        """
        scene = scene_of(motion, targets=targets, mask=mask)
        picture = MovingPicture(
            scene, title=motion.text if title is None else title, size=size, follow=follow
        )
        images = [
            _gif_image(frame)
            for frame in tqdm(picture.frames(), total=scene.num_frames, disable=not progress)
        ]
        with replaced_on_success(path) as partial:
            images[0].save(
                partial, save_all=True, append_images=images[1:], duration=round(1000 / scene.fps), loop=0,
                optimize=False,
            )  # fmt: skip

    @staticmethod
    def load(path: Path) -> Motion:
        """A picture holds no motion: always raises ``ValueError``."""
        raise ValueError(
            f"{path}: a .gif is a picture of a motion and cannot be loaded. Load the .npz or .bvh."
        )


class Mp4Format:
    """Writer of ``.mp4``; needs the extra ``video``."""

    @staticmethod
    def save(
        motion: Motion,
        path: Path,
        *,
        targets: Any = None,
        mask: Any = None,
        title: str | None = None,
        size: tuple[int, int] = (960, 720),
        follow: bool = False,
        progress: bool = False,
    ) -> None:
        """Write the figure with its targets and trails, at the motion's frame rate. Options as for ``.gif``.

        Raises:
            ImportError: If PyAV is not installed.
            ValueError: As for ``.gif``.
        """
        av = _import_av()
        scene = scene_of(motion, targets=targets, mask=mask)
        picture = MovingPicture(
            scene, title=motion.text if title is None else title, size=size, follow=follow
        )
        frames = tqdm(picture.frames(), total=scene.num_frames, disable=not progress)
        with replaced_on_success(path) as partial:
            _write_video(av, partial, frames, size=size, fps=scene.fps)

    @staticmethod
    def load(path: Path) -> Motion:
        """A video holds no motion: always raises ``ValueError``."""
        raise ValueError(
            f"{path}: a .mp4 is a video of a motion and cannot be loaded. Load the .npz or .bvh."
        )


def _gif_image(frame: ndarray) -> Image.Image:
    # No dithering: on flat colours it adds flicker and doubles the file.
    return Image.fromarray(frame).quantize(_GIF_COLORS, dither=Image.Dither.NONE)


def _import_av() -> Any:
    try:
        import av
    except ImportError:
        raise ImportError(
            "Writing .mp4 needs PyAV: pip install 'controlmm[video]' (or save a .gif)."
        ) from None
    return av


def _write_video(
    av: Any, path: Path, frames: Iterable[ndarray], *, size: tuple[int, int], fps: float
) -> None:
    codec = next(name for name in _VIDEO_CODECS if name in av.codecs_available)
    with av.open(str(path), mode="w") as container:
        stream = container.add_stream(codec, rate=Fraction(fps).limit_denominator(1000))
        stream.width, stream.height = size
        stream.pix_fmt = "yuv420p"
        if codec == "libx264":
            stream.options = {"crf": "20", "preset": "veryfast"}
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        container.mux(stream.encode())
