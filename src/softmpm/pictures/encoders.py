"""Writers of films: pictures one after the other as a GIF or an MP4."""

import itertools
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np

FAILED = "ffmpeg could not write the film, perhaps for want of room on the disk"
EXACT = 128
"""Colours of a picture of a GIF that are exact, of 256; the others are covered by the rest."""


def _quantised(picture: np.ndarray) -> Any:
    """The picture in 256 colours. The most frequent ones are exact, so that plain areas do not change from picture to picture."""
    from PIL import Image

    packed, places, counts = np.unique(
        picture @ np.array([1 << 16, 1 << 8, 1]), return_inverse=True, return_counts=True
    )
    colours = np.stack([packed >> 16, packed >> 8 & 255, packed & 255], axis=1).astype(np.uint8)
    order = np.argsort(-counts, kind="stable")
    palette, others = colours[order[:EXACT]], colours[order[EXACT:]]
    if len(others):  # the median cut would lose the colours of small things, such as arrows
        covered = Image.fromarray(others[None]).quantize(256 - EXACT, Image.Quantize.MAXCOVERAGE)
        palette = np.concatenate([palette, np.reshape(covered.getpalette() or [], (-1, 3))]).astype(np.uint8)
    one, other = colours.astype(float), palette.astype(float)
    nearest = (np.square(other).sum(axis=1) - 2 * one @ other.T).argmin(axis=1).astype(np.uint8)
    image = Image.fromarray(nearest[places].reshape(picture.shape[:2]))
    image.putpalette(palette.tobytes())
    return image


def _write_gif(path: Path, pictures: Iterable[np.ndarray], fps: int) -> None:
    frames = [_quantised(picture) for picture in pictures]
    ends = [round(100 * k / fps) for k in range(len(frames) + 1)]  # a GIF counts in hundredths of a second
    lasting = [10 * (end - begin) for begin, end in itertools.pairwise(ends)]
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=lasting, loop=0)


def _write_mp4(path: Path, pictures: Iterable[np.ndarray], fps: int) -> None:
    try:
        import imageio_ffmpeg
    except ImportError as error:
        raise ImportError(
            'an MP4 needs the package imageio-ffmpeg: pip install "softmpm[video]". A .gif needs no further package.'
        ) from error
    writer, sent = None, 0
    try:
        for picture in pictures:
            if writer is None:
                size = (picture.shape[1], picture.shape[0])
                writer = imageio_ffmpeg.write_frames(
                    str(path), size, fps=fps, macro_block_size=2, ffmpeg_log_level="error"
                )
                writer.send(None)
            writer.send(np.ascontiguousarray(picture))
            sent += 1
    except BrokenPipeError as error:
        raise OSError(f"{FAILED}, of which {sent} pictures were sent.") from error
    finally:
        if writer is not None:
            writer.close()
    _need_whole(path, sent)


def _need_whole(path: Path, sent: int) -> None:
    """Raise OSError unless a film has all pictures: where the disk is full, ffmpeg may end without an error."""
    import imageio_ffmpeg

    try:
        written = imageio_ffmpeg.count_frames_and_secs(str(path))[0]
    except RuntimeError:
        written = 0
    if written != sent:
        raise OSError(f"{FAILED}: it has {written} of {sent} pictures.")


WRITERS: dict[str, Callable[[Path, Iterable[np.ndarray], int], None]] = {
    ".gif": _write_gif,
    ".mp4": _write_mp4,
}
