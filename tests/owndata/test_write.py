"""A dataset is written whole, or not at all."""

import numpy as np
import pytest

from jaxdeconf.formats import find
from jaxdeconf.formats.source import Names
from jaxdeconf.owndata.write import write_dataset
from tests.owndata.scene import scene


@pytest.mark.parametrize("fault", ["disk", "codec"])
def test_of_what_cannot_be_written_nothing_stays(tmp_path, fault):
    """A disk that is full at the last episode; frames that do not read back as they were drawn."""
    np.savez(tmp_path / "demos.npz", **scene(5, 3, True, 0))
    source, seen = find(tmp_path / "demos.npz", None, Names()), []

    def view(frames):
        seen.append(len(frames))
        if fault == "disk" and len(seen) == 5:
            raise OSError("no space left")
        return frames // 2

    def smeared(to, redraw):
        write(to, lambda frames: redraw(frames) + 1)

    write = source.write
    source = source if fault == "disk" else source._replace(write=smeared)
    words = {"disk": "no space left", "codec": "what was written does not read back"}[fault]
    with pytest.raises(OSError, match=words):
        write_dataset(source, Names(), None, tmp_path / "out/dataset/demos.npz", view)
    assert not [*tmp_path.glob("out/*")]
