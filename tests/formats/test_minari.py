"""Minari's folders, as its 0.5 writes them: HDF5 and Arrow, raw frames and JPEG, one the more."""

import io
import json

import numpy as np
import pytest
from PIL import Image

from jaxdeconf.formats import find
from jaxdeconf.formats.source import Names
from jaxdeconf.owndata import dataset
from jaxdeconf.owndata.write import write_dataset

h5py = pytest.importorskip("h5py")
pa = pytest.importorskip("pyarrow")
LENGTHS = [4, 6, 4, 4, 4]
SMOOTH = np.add.outer(np.arange(32), np.arange(32))[..., None] * np.array([1, 2, 3])
ACTIONS = [np.random.default_rng(n).normal(size=(length, 2)) for n, length in enumerate(LENGTHS)]
FRAMES = [np.stack([SMOOTH + step for step in range(n + 1)]).astype(np.uint8) for n in LENGTHS]


def jpeg(image):
    file = io.BytesIO()
    Image.fromarray(image).save(file, "JPEG")
    return file.getvalue()


def save_hdf5(path, encoded):
    with h5py.File(path / "data/main_data.hdf5", "w") as file:
        for number, frames in enumerate(FRAMES):
            episode = file.create_group(f"episode_{number}")
            episode.attrs["seed"] = number
            episode["actions"] = ACTIONS[number]
            episode["infos/qpos"] = np.full((len(frames), 2), number)
            episode["infos/qvel"] = np.full((len(frames), 1), -number)
            episode["observations/state"] = np.zeros((len(frames), 8))
            if encoded:
                kind = h5py.vlen_dtype(np.uint8)
                made = episode.create_dataset("observations/pixels", (len(frames),), kind)
                for place, frame in enumerate(frames):
                    made[place] = np.frombuffer(jpeg(frame), np.uint8)
            else:
                episode["observations/pixels"] = frames


def lists(rows):
    """Arrow's lists of fixed length of rows [T, ...]."""
    flat = np.ascontiguousarray(rows).reshape(len(rows), -1)
    return pa.FixedSizeListArray.from_arrays(pa.array(flat.ravel()), flat.shape[1])


def save_arrow(path, encoded):
    for number, frames in enumerate(FRAMES):
        images = pa.array([jpeg(frame) for frame in frames]) if encoded else lists(frames)
        state, count = lists(np.zeros((len(frames), 8))), np.full(len(frames), number)
        shape = {"metadata": {"shape": "2"}}
        qpos = pa.field("qpos", pa.list_(pa.int64(), 2), **shape)
        infos = [lists(np.stack([count, count], axis=1)), lists(-count)]
        batch = pa.RecordBatch.from_pydict(
            {
                "observations": pa.StructArray.from_arrays([images, state], ["pixels", "state"]),
                "actions": lists(np.pad(ACTIONS[number], ((0, 1), (0, 0)))),
                "rewards": np.zeros(len(frames)),
                "infos": pa.StructArray.from_arrays(
                    infos, fields=[qpos, pa.field("qvel", infos[1].type)]
                ),
            }
        )
        part = path / f"data/{number}/part-0.arrow"
        part.parent.mkdir()
        (part.parent / "metadata.json").write_text(json.dumps({"id": number, "seed": number}))
        with pa.ipc.new_file(str(part), batch.schema) as file:
            file.write_batch(batch)


@pytest.fixture(params=["hdf5", "arrow"])
def form(request):
    return request.param


@pytest.fixture(params=[False, True], ids=["raw", "jpeg"])
def path(request, tmp_path, form):
    path = tmp_path / "reach-v0"
    (path / "data").mkdir(parents=True)
    spaces = {"pixels": {"type": "Box", "shape": [32, 32, 3]}, "state": {"type": "Box"}}
    about = {"dataset_id": "reach-v0", "data_format": form, "jpeg_encoding": request.param}
    about["observation_space"] = json.dumps({"type": "Dict", "subspaces": spaces})
    (path / "data/metadata.json").write_text(json.dumps(about))
    {"hdf5": save_hdf5, "arrow": save_arrow}[form](path, request.param)
    return path


def inverted(images):
    return 255 - images


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
    assert np.array_equal(source.actions, np.concatenate(ACTIONS))


def test_it_is_written_without_loss_and_read_again(path, tmp_path):
    source, new = find(path, None, Names()), tmp_path / "new" / "reach-v0"
    new.parent.mkdir()
    source.write(new, inverted)
    written = find(new, None, Names())
    for before, after in zip(source.episodes(), written.episodes(), strict=True):
        assert np.array_equal(after, inverted(before))
    assert not json.loads((new / "data/metadata.json").read_text())["jpeg_encoding"]
    assert len(kept(new)) == len(kept(path)) > 0
    for after, before in zip(kept(new), kept(path), strict=True):
        assert after == before


def test_what_a_masking_writes_reads_back(path, tmp_path):
    place, source = tmp_path / "out/dataset/reach", find(path, None, Names())
    write_dataset(source, Names(), None, place, inverted)
    for before, after in zip(source.episodes(), find(place, None, Names()).episodes(), strict=True):
        assert np.array_equal(after, inverted(before))


def kept(path):
    """All that is not the camera's, in a form that can be compared."""
    found = [file.read_bytes() for file in sorted(path.glob("data/*/metadata.json"))]
    for part in sorted(path.glob("data/*/part-0.arrow")):
        table = pa.ipc.open_file(str(part)).read_all()
        assert len(table) == LENGTHS[int(part.parent.name)] + 1
        state = table["observations"].combine_chunks().field("state")
        found += [table.drop_columns("observations"), state, table.schema.field("infos").type[0]]
    for file in path.glob("data/main_data.hdf5"):
        with h5py.File(file) as opened:
            for name, episode in opened.items():
                found += [name, dict(episode.attrs), len(episode["observations/pixels"])]
                for key in ("actions", "infos/qpos", "infos/qvel", "observations/state"):
                    found.append(episode[key][:].tolist())
    return found


@pytest.mark.parametrize("form", ["hdf5"])
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


@pytest.mark.parametrize("form", ["arrow"])
def test_what_is_wrong_with_arrow_files_is_said_in_one_line(path):
    part = path / "data/3/part-0.arrow"
    part.write_bytes(part.read_bytes()[:700])
    with pytest.raises(ValueError, match=r"part-0\.arrow: expected an Arrow file, got 700 bytes"):
        find(path, None, Names())
    part.unlink()
    with pytest.raises(ValueError, match=r"expected an Arrow file, got no file of that name"):
        find(path, None, Names())
