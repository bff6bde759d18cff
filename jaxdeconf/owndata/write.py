"""The new dataset: written beside its place, read back, and only then put there."""

import shutil
import zlib
from pathlib import Path

import numpy as np

from jaxdeconf.formats import find
from jaxdeconf.formats.source import Names, Source
from jaxdeconf.owndata.view import View
from jaxdeconf.pipeline.plain import PARTIAL


def write_dataset(source: Source, names: Names, format: str | None, place: Path, view: View):
    """Writes a dataset again with what a view makes of its frames.

    Args:
      source: the old one.
      names: what of it was taken.
      format: of both.
      place: DIR/dataset/NAME; nothing is there, or what was written before, which is kept.
      view: what its frames become.
    Raises:
      OSError: if it cannot be written, or does not read back as it was written; nothing is left.
    """
    if place.parent.exists():
        return
    partial = place.parent.with_name(place.parent.name + PARTIAL)
    shutil.rmtree(partial, ignore_errors=True)  # a killed run's
    became: dict[int, int] = {}

    def redraw(frames: np.ndarray) -> np.ndarray:
        after = view(frames)
        if (frames == frames[..., :1]).all():  # a grey camera stays one
            after = np.repeat(after.mean(axis=-1, keepdims=True).round(), 3, axis=-1)
            after = after.astype(np.uint8)
        became[_sum(frames)] = _sum(after)
        return after

    try:
        partial.mkdir(parents=True)
        source.write(partial / place.name, redraw)
        written = find(partial / place.name, format, names)
        for before, after in zip(source.episodes(), written.episodes(), strict=True):
            if became[_sum(before)] != _sum(after):
                raise OSError(f"{partial / place.name}: what was written does not read back")
        partial.rename(place.parent)
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise


def _sum(frames: np.ndarray) -> int:
    return zlib.crc32(np.ascontiguousarray(frames).tobytes())
