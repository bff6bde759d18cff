"""The reference format: what is read, what is written again, and what is said of a damaged file."""

import numpy as np
import pytest

from jaxdeconf.formats import find
from jaxdeconf.formats.source import Names
from jaxdeconf.owndata import dataset

LENGTHS = np.array([3, 1, 2])


def arrays(**changes):
    random = np.random.default_rng(0)
    good = {
        "frames": random.integers(0, 256, (6, 32, 40, 3), dtype=np.uint8),
        "actions": random.normal(size=(6, 2)),
        "episode_lengths": LENGTHS,
        "initial_states": random.normal(size=(3, 4)),
    }
    return {name: value for name, value in {**good, **changes}.items() if value is not None}


@pytest.fixture
def saved(tmp_path):
    def save(names=None, path=tmp_path / "demos.npz", **changes):
        np.savez_compressed(path, **arrays(**changes))
        return path, find(path, None, names or Names())

    return save


def read(saved, **changes):
    return dataset.read(*saved(**changes), 32)


def test_it_is_read_an_episode_at_a_time(saved):
    _, source = saved()
    assert [len(frames) for frames in source.episodes()] == LENGTHS.tolist()
    assert np.array_equal(np.concatenate([*source.episodes()]), arrays()["frames"])
    assert source.size == (32, 40)


@pytest.mark.parametrize(
    ("store", "back"),
    [
        (lambda f: f.transpose(0, 3, 1, 2), lambda f: f.transpose(0, 2, 3, 1)),
        (lambda f: (f / 255).astype(np.float32), lambda f: np.round(f * 255)),
        (lambda f: f.astype(np.float64), lambda f: f),
        (lambda f: np.concatenate([f, f[..., :1]], axis=-1), lambda f: f[..., :3]),
    ],
)
def test_frames_of_every_form_are_read_and_written_in_it(saved, tmp_path, store, back):
    """Channels first, floats, four channels: the same pixels, and a change lands in them."""
    frames = arrays()["frames"]
    _, source = saved(frames=store(frames))
    assert np.array_equal(np.concatenate([*source.episodes()]), frames)

    def blacken(images):
        images = images.copy()
        images[:, :4, :5] = 0
        return images

    source.write(tmp_path / "new.npz", blacken)
    with np.load(tmp_path / "new.npz") as new:
        assert new["frames"].dtype == store(frames).dtype
        assert np.array_equal(back(new["frames"]).astype(np.uint8), blacken(frames))
        assert np.array_equal(new["actions"], arrays()["actions"])


def test_a_grey_camera_is_read_as_three_equal_colours(saved):
    grey = arrays()["frames"][..., :1]
    _, source = saved(frames=grey)
    assert np.array_equal(np.concatenate([*source.episodes()]), grey.repeat(3, axis=-1))


def test_actions_come_over_their_limit_or_their_largest(saved):
    raw = arrays()["actions"]
    largest = read(saved).actions
    assert np.allclose(largest, raw / np.abs(raw).max(axis=0))
    said = read(saved, action_limit=np.array([10.0, 5.0]))
    assert np.allclose(said.actions, raw / [10, 5])


def test_initial_states_may_come_from_a_file_of_their_own(saved, tmp_path):
    np.save(tmp_path / "states.npy", np.eye(3))
    names = Names(initial_states=str(tmp_path / "states.npy"))
    assert read(saved, names=names, initial_states=None).state_names == ["s0", "s1", "s2"]


NAN = np.array([[1.0, np.nan]] * 3)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"frames": None}, r"expected frames, got only .*actions.*; say --frames KEY"),
        (
            {"frames": None, "a": arrays()["frames"], "b": arrays()["frames"]},
            "expected one --frames of a, b, got none",
        ),
        ({"names": Names(frames="top")}, "expected top, got only frames, actions"),
        ({"actions": None}, "expected actions, got only frames"),
        ({"episode_lengths": None}, "expected episode_lengths, got only frames"),
        ({"episode_lengths": np.array([3, 1, 3])}, "lengths of 6 frames in all, got 7"),
        ({"episode_lengths": np.array([4, 0, 2])}, "expected episodes of one step or more"),
        ({"initial_states": None}, r"none; say --initial-states KEY, or FILE.npy of \[3, S\]"),
        (
            {"initial_states": np.ones((2, 4))},
            r"initial states: expected numbers of shape \[3, S\]",
        ),
        ({"initial_states": NAN}, r"initial states: expected finite numbers, got nan at \[0, 1\]"),
        ({"initial_states": np.ones((3, 4))}, "expected initial states that vary"),
        ({"actions": np.ones((6, 2))}, "expected actions that vary"),
        ({"actions": NAN.repeat(2, axis=0)}, "actions: expected finite numbers, got nan"),
        ({"actions": np.ones(6)}, r"actions: expected numbers of shape \[6, A\]"),
        ({"frames": np.zeros((6, 32, 40, 3), np.int32)}, r"images \[T, H, W, 3\], uint8 or floats"),
        ({"frames": np.zeros((6, 32, 40))}, r"uint8 or floats, got float64 of shape \[3, 32, 40\]"),
        ({"frames": np.full((6, 32, 40, 3), -1.0)}, r"\[0, 1\] or \[0, 255\], got -1 to -1"),
        ({"frames": np.asfortranarray(arrays()["frames"])}, "in C order, got Fortran order"),
        (
            {"actions": np.array([[1.0], [1.0, 2.0]], object)},
            "got Python objects, which are pickle",
        ),
    ],
)
def test_what_is_wrong_is_said_in_one_line(saved, changes, words):
    with pytest.raises(ValueError, match=words) as error:
        read(saved, **changes)
    assert "\n" not in str(error.value)
    assert "demos.npz" in str(error.value)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"version https://git-lfs.github.com/spec/v1\n", "a Git LFS pointer"),
        (b"<!DOCTYPE html><html>", "a web page; download the file itself"),
        (b"PK\x03\x04 cut off", "12 bytes that are damaged, cut off"),
        (b"", "0 bytes that are damaged, cut off"),
    ],
)
def test_a_file_that_is_none_is_said_to_be_what_it_is(tmp_path, content, words):
    (tmp_path / "demos.npz").write_bytes(content)
    with pytest.raises(ValueError, match=words):
        find(tmp_path / "demos.npz", None, Names())


def test_a_file_that_was_cut_off_or_changed_is_refused(saved):
    path, source = saved()
    whole = path.read_bytes()
    path.write_bytes(whole[:-100])
    with pytest.raises(ValueError, match=f"expected an npz file, got {len(whole) - 100} bytes"):
        find(path, None, Names())
    path.write_bytes(whole[:3000] + bytes(1000) + whole[4000:])
    with pytest.raises(ValueError, match="expected an npz file, got"):
        [*source.episodes()]


def test_what_is_no_dataset_is_named(tmp_path):
    with pytest.raises(ValueError, match="expected a dataset, got no file or folder"):
        find(tmp_path / "nothing", None, Names())
    (tmp_path / "notes.txt").write_text("notes")
    with pytest.raises(ValueError, match=r"expected an npz file, .*, got 5 bytes"):
        find(tmp_path / "notes.txt", None, Names())
    with pytest.raises(ValueError, match=r"got a folder of notes\.txt"):
        find(tmp_path, None, Names())
    with pytest.raises(ValueError, match="format: expected one of npz"):
        find(tmp_path, "zarr", Names())
