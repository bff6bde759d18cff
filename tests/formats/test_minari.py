"""Minari's folders in HDF5, as its 0.5 writes them: raw and JPEG frames, one more than actions."""

import io
import json

import numpy as np
import pytest
from PIL import Image

from jaxdeconf.formats import find
from jaxdeconf.formats.source import Names
from jaxdeconf.owndata import dataset

h5py = pytest.importorskip("h5py")
LENGTHS = [4, 6, 4, 4, 4]
SMOOTH = np.add.outer(np.arange(32), np.arange(32))[..., None] * np.array([1, 2, 3])
FRAMES = [np.stack([SMOOTH + step for step in range(n + 1)]).astype(np.uint8) for n in LENGTHS]


def jpeg(image):
    file = io.BytesIO()
    Image.fromarray(image).save(file, "JPEG")
    return np.frombuffer(file.getvalue(), np.uint8)


@pytest.fixture(params=[False, True], ids=["raw", "jpeg"])
def path(request, tmp_path):
    path = tmp_path / "reach-v0"
    (path / "data").mkdir(parents=True)
    about = {"dataset_id": "reach-v0", "data_format": "hdf5", "jpeg_encoding": request.param}
    (path / "data/metadata.json").write_text(json.dumps(about))
    with h5py.File(path / "data/main_data.hdf5", "w") as file:
        for number, frames in enumerate(FRAMES):
            episode = file.create_group(f"episode_{number}")
            episode.attrs["seed"] = number
            episode["actions"] = np.random.default_rng(number).normal(size=(len(frames) - 1, 2))
            episode["infos/qpos"] = np.full((len(frames), 2), number)
            episode["infos/qvel"] = np.full((len(frames), 1), -number)
            episode["observations/state"] = np.zeros((len(frames), 8))
            if request.param:
                kind = h5py.vlen_dtype(np.uint8)
                made = episode.create_dataset("observations/pixels", (len(frames),), kind)
                for place, frame in enumerate(frames):
                    made[place] = jpeg(frame)
            else:
                episode["observations/pixels"] = frames
    return path


def test_frames_before_an_action_and_initial_states_are_read(path):
    source = find(path, None, Names())
    assert source.lengths.tolist() == LENGTHS
    error = [
        np.abs(a.astype(int) - b[:-1]).mean()
        for a, b in zip(source.episodes(), FRAMES, strict=True)
    ]
    exact = not json.loads((path / "data/metadata.json").read_text())["jpeg_encoding"]
    assert max(error) <= (0.0 if exact else 8.0)
    read = dataset.read(path, source, 32)
    assert read.initial_states.tolist() == [[n, n, -n] for n in range(5)]


def test_it_is_written_without_loss_and_read_again(path, tmp_path):
    source, new = find(path, None, Names()), tmp_path / "new" / "reach-v0"
    new.parent.mkdir()

    def inverted(images):
        return 255 - images

    source.write(new, inverted)
    written = find(new, None, Names())
    for before, after in zip(source.episodes(), written.episodes(), strict=True):
        assert np.array_equal(after, inverted(before))
    assert not json.loads((new / "data/metadata.json").read_text())["jpeg_encoding"]
    with h5py.File(new / "data/main_data.hdf5") as file:
        assert file["episode_3"].attrs["seed"] == 3
        assert len(file["episode_1/observations/pixels"]) == LENGTHS[1] + 1
        assert file["episode_1/infos/qpos"][0].tolist() == [1, 1]


def test_what_is_wrong_is_said_in_one_line(path):
    file = path / "data/main_data.hdf5"
    with h5py.File(file, "r+") as opened:
        del opened["episode_2/observations/pixels"]
    with pytest.raises(ValueError, match="expected observations/pixels in episode_2, got none"):
        find(path, None, Names())
    file.write_bytes(file.read_bytes()[:900])
    with pytest.raises(ValueError, match="expected an HDF5 file, got 900 bytes"):
        find(path, None, Names())
    file.unlink()
    with pytest.raises(ValueError, match="write the dataset again with data_format='hdf5'"):
        find(path, None, Names())
