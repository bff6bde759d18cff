"""robomimic's HDF5 files: written by h5py as its documentation says, read, and written again."""

import numpy as np
import pytest

from jaxdeconf.formats import find
from jaxdeconf.formats.source import Names
from jaxdeconf.owndata import dataset

h5py = pytest.importorskip("h5py")
RANDOM = np.random.default_rng(0)
FRAMES = [RANDOM.integers(0, 256, (length, 84, 84, 3), dtype=np.uint8) for length in [3, 5] * 6]


@pytest.fixture
def path(tmp_path):
    """Twelve demonstrations, two cameras; demo_10 comes after demo_9, not after demo_1."""
    path = tmp_path / "image.hdf5"
    with h5py.File(path, "w") as file:
        file.create_group("data").attrs["env_args"] = "{}"
        file["mask/train"] = np.array([b"demo_0"])
        for number, frames in enumerate(FRAMES):
            demo = file.create_group(f"data/demo_{number}")
            demo["actions"] = RANDOM.uniform(-1, 1, (len(frames), 2))
            demo["states"] = np.full((len(frames), 3), [0.0, number, number**2])
            demo["obs/agentview_image"] = frames
            demo["obs/joints"] = np.zeros((len(frames), 7))
            demo["next_obs/agentview_image"] = np.roll(frames, -1, axis=0)
    return path


def change(path, edit):
    with h5py.File(path, "r+") as file:
        edit(file)


def test_frames_and_initial_states_are_read_in_the_order_of_their_numbers(path):
    source = find(path, None, Names())
    assert source.frames == "agentview_image"
    assert all(np.array_equal(a, b) for a, b in zip(source.episodes(), FRAMES, strict=True))
    read = dataset.read(path, source, 64)
    assert read.frames.shape == (48, 64, 64, 3)
    assert read.initial_states[:, 1].tolist() == [*range(12)]


def test_only_the_camera_is_written_anew(path, tmp_path):
    def darker(images):
        return images // 2

    find(path, None, Names()).write(tmp_path / "new.hdf5", darker)
    with h5py.File(path) as old, h5py.File(tmp_path / "new.hdf5") as new:

        def compare(name, value):
            if isinstance(value, h5py.Dataset):
                camera = name.endswith("agentview_image")
                wanted = darker(value[:]) if camera else value[:]
                assert new[name].dtype == value.dtype
                assert np.array_equal(new[name][:], wanted)

        old.visititems(compare)
        assert dict(new["data"].attrs) == dict(old["data"].attrs)


def test_isaac_labs_initial_states_are_flattened_and_named(path):
    def edit(file):
        for number in range(len(FRAMES)):
            demo = file[f"data/demo_{number}"]
            del demo["states"]
            demo["initial_state/rigid_object/cube/root_pose"] = [[number, 1.0]]

    change(path, edit)
    source = find(path, None, Names())
    assert source.state_names == ["rigid_object/cube/root_pose.0", "rigid_object/cube/root_pose.1"]
    assert source.initial_states is not None
    assert source.initial_states[:, 0].tolist() == [*range(12)]


def remove(*names):
    def edit(file):
        for name in names:
            del file[name]

    return edit


def second_camera(file):
    file["data/demo_0/obs/wrist_image"] = FRAMES[0]


def too_few_actions(file):
    del file["data/demo_3/actions"]
    file["data/demo_3/actions"] = np.zeros((2, 2))


@pytest.mark.parametrize(
    ("edit", "names", "words"),
    [
        (remove("data"), Names(), "expected data/demo_0, got only mask"),
        (remove("data/demo_0/obs"), Names(), r"run robomimic's dataset_states_to_obs\.py first"),
        (remove("data/demo_3/obs/agentview_image"), Names(), "agentview_image in demo_3, got none"),
        (remove("data/demo_0/actions"), Names(), "expected actions, got only next_obs, obs"),
        (too_few_actions, Names(), "actions of demo_3: expected 5 steps, got 2"),
        (second_camera, Names(), "one --frames of agentview_image, wrist_image, got none"),
        (second_camera, Names(frames="wrist"), "expected wrist, got only agentview_image, joints"),
        (remove("data/demo_2/states"), Names(), "expected initial states, .*, got none"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(path, edit, names, words):
    change(path, edit)
    with pytest.raises(ValueError, match=words) as error:
        dataset.read(path, find(path, None, names), 64)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("length", [5000, 40])
def test_a_file_that_was_cut_off_is_refused(path, length):
    path.write_bytes(path.read_bytes()[:length])
    with pytest.raises(ValueError, match=f"expected an HDF5 file, got {length} bytes"):
        find(path, None, Names())


def test_without_h5py_the_line_to_install_it_is_said(path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "h5py", None)
    with pytest.raises(ValueError, match=r"pip install 'jaxdeconf\[robomimic\]'"):
        find(path, None, Names())
