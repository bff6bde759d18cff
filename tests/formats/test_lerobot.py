"""LeRobot's folders, v3 and v2.1, images and video: laid out as its writers do, read, and written.

The videos here are coded without loss, so that what is read can be compared to the bit.
"""

import json

import numpy as np
import pytest
from PIL import Image

from jaxdeconf.formats import find
from jaxdeconf.formats.lerobot.levels import Levels
from jaxdeconf.formats.source import Names
from jaxdeconf.owndata import dataset
from jaxdeconf.owndata.write import write_dataset

av = pytest.importorskip("av")
pa = pytest.importorskip("pyarrow")
pq = pytest.importorskip("pyarrow.parquet")
RANDOM = np.random.default_rng(0)
CAMERA, FPS, LENGTHS = "observation.images.top", 10, [4, 6, 3]
FRAMES = [RANDOM.integers(0, 256, (n, 32, 40, 3), dtype=np.uint8) for n in LENGTHS]
STATES = [RANDOM.normal(size=(n, 2)).astype(np.float32) for n in LENGTHS]
ACTIONS = [RANDOM.normal(size=(n, 1)).astype(np.float32) for n in LENGTHS]
FILES = {"v3.0": [[0, 1], [2]], "v2.1": [[0], [1], [2]]}  # the episodes in each
TEMPLATES = {
    "v3.0": (
        "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
    ),
    "v2.1": (
        "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
        "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4",
    ),
}


def png(image, path):
    Image.fromarray(image).save(path, "PNG")
    return path.read_bytes()


def save_video(path, frames):
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as file:
        stream = file.add_stream("libx264rgb", rate=FPS, options={"crf": "0"})
        stream.width, stream.height, stream.pix_fmt = 40, 32, "rgb24"
        for frame in frames:
            file.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        file.mux(stream.encode())


def rows(episode, number, scratch, video):
    """A table of one episode's frames, as LeRobot writes one."""
    frames, start = FRAMES[episode], sum(LENGTHS[:episode])
    count = np.arange(len(frames))
    known = {
        "observation.state": pa.array(list(STATES[episode]), pa.list_(pa.float32(), 2)),
        "action": pa.array(list(ACTIONS[episode]), pa.list_(pa.float32(), 1)),
        "timestamp": pa.array((count / FPS).astype(np.float32)),
        "frame_index": pa.array(count),
        "episode_index": pa.array(np.full(len(frames), number)),
        "index": pa.array(start + count),
    }
    types = {key: {"dtype": "float32", "_type": "Value"} for key in known}
    if not video:
        stored = [png(frame, scratch) for frame in frames]
        names = [f"frame-{at:06d}.png" for at in count]
        image = pa.StructArray.from_arrays([pa.array(stored), pa.array(names)], ["bytes", "path"])
        known, types = {CAMERA: image, **known}, {CAMERA: {"_type": "Image"}, **types}
    about = {"huggingface": json.dumps({"info": {"features": types}})}
    return pa.table(known).replace_schema_metadata(about)


def statistics(frames):
    """Reference: NumPy on all pixels."""
    colours = (frames / 255).reshape(-1, 3)
    found = {name: getattr(colours, name)(axis=0) for name in ("min", "max", "mean", "std")}
    found["q50"] = np.quantile(colours, 0.5, axis=0, method="inverted_cdf")
    plain = {name: value[:, None, None].tolist() for name, value in found.items()}
    return plain | {"count": [len(frames)]}


def save(path, version, video):
    """A dataset of FRAMES; a second file in v3, a row group an episode."""
    data, videos = TEMPLATES[version]
    image = {"dtype": "video" if video else "image", "shape": [32, 40, 3]}
    features = {
        CAMERA: {**image, "names": ["height", "width", "channels"]},
        "observation.state": {"dtype": "float32", "shape": [2], "names": {"motors": ["x", "y"]}},
        "action": {"dtype": "float32", "shape": [1], "names": None},
    }
    info = {"codebase_version": version, "fps": FPS, "features": features, "chunks_size": 1000}
    info |= {"data_path": data, "video_path": videos if video else None, "total_episodes": 3}
    if version == "v2.1":
        info["total_videos"] = 3 * video
    episodes, each = [], []
    for number, within in enumerate(FILES[version]):
        place = {"chunk_index": 0, "file_index": number}
        names = {**place, "episode_chunk": 0, "episode_index": number, "video_key": CAMERA}
        file = path / data.format(**names)
        file.parent.mkdir(parents=True, exist_ok=True)
        tables = [rows(episode, episode, path / "scratch.png", video) for episode in within]
        with pq.ParquetWriter(file, tables[0].schema) as writer:
            for table in tables:
                writer.write_table(table)
        if video:
            save_video(path / videos.format(**names), np.concatenate([FRAMES[e] for e in within]))
        for episode in within:
            row = {"episode_index": episode, "tasks": ["reach"], "length": LENGTHS[episode]}
            if version == "v3.0":
                row |= {f"data/{key}": value for key, value in place.items()}
                if video:
                    row |= {f"videos/{CAMERA}/{key}": value for key, value in place.items()}
                    before = sum(LENGTHS[e] for e in within if e < episode)
                    row[f"videos/{CAMERA}/from_timestamp"] = before / FPS
            episodes.append(row)
            each.append(statistics(FRAMES[episode]))
    (path / "scratch.png").unlink(missing_ok=True)
    meta = path / "meta"
    meta.mkdir()
    (meta / "info.json").write_text(json.dumps(info))
    if version == "v2.1":
        (meta / "episodes.jsonl").write_text("".join(json.dumps(row) + "\n" for row in episodes))
        stats = [{"episode_index": n, "stats": {CAMERA: one}} for n, one in enumerate(each)]
        text = "".join(json.dumps(line) + "\n" for line in stats)
        (meta / "episodes_stats.jsonl").write_text(text)
    else:
        for row, one in zip(episodes, each, strict=True):
            row |= {f"stats/{CAMERA}/{key}": value for key, value in one.items()}
        (meta / "episodes/chunk-000").mkdir(parents=True)
        pq.write_table(pa.Table.from_pylist(episodes), meta / "episodes/chunk-000/file-000.parquet")
        stats = {CAMERA: statistics(np.concatenate(FRAMES)), "action": {"min": [-1.0]}}
        (meta / "stats.json").write_text(json.dumps(stats))


@pytest.fixture(params=["v3.0", "v2.1"])
def version(request):
    return request.param


@pytest.fixture(params=[False, True], ids=["images", "video"])
def path(request, tmp_path, version):
    save(tmp_path / "reach", version, request.param)
    return tmp_path / "reach"


def darker(images):
    images = images.copy()
    images[:, :8] //= 2
    return images


def test_frames_and_initial_states_are_read(path):
    source = find(path, None, Names())
    assert source.frames == CAMERA
    assert source.lengths.tolist() == LENGTHS
    assert all(np.array_equal(a, b) for a, b in zip(source.episodes(), FRAMES, strict=True))
    assert np.array_equal(source.actions, np.concatenate(ACTIONS))
    read = dataset.read(path, source, 32)
    assert read.state_names == ["x", "y"]
    assert np.array_equal(read.initial_states, [states[0] for states in STATES])
    assert "is all that is known of how episodes began" in source.notes[0]


def test_it_is_written_without_loss_and_only_the_camera_differs(path, version, tmp_path):
    new, source = tmp_path / "new", find(path, None, Names())
    source.write(new, darker)
    written = find(new, None, Names())
    for after, before in zip(written.episodes(), FRAMES, strict=True):
        assert np.array_equal(after, darker(before))
    old_info, info = (json.loads((place / "meta/info.json").read_text()) for place in (path, new))
    assert info["features"][CAMERA]["dtype"] == "image"
    assert info["video_path"] is None
    assert not info.get("total_videos")
    if not (video := old_info["video_path"] is not None):
        assert (path / "meta/info.json").read_bytes() == (new / "meta/info.json").read_bytes()
    files = [*(path / "data").rglob("*.parquet")]
    assert len(files) == len(FILES[version])
    for file in files:
        old, now = (pq.ParquetFile(place / file.relative_to(path)) for place in (path, new))
        assert old.num_row_groups == now.num_row_groups
        before, after = old.read(), now.read()
        assert before.select(kept := [k for k in before.column_names if k != CAMERA]).equals(
            after.select(kept)
        )
        assert after.column_names[0] == CAMERA
        about = json.loads(now.schema_arrow.metadata[b"huggingface"])["info"]["features"]
        assert [*about] == after.column_names
        assert about[CAMERA] == {"_type": "Image"}
        paths = after[CAMERA].combine_chunks().field("path").to_pylist()
        assert paths[:2] == ["frame-000000.png", "frame-000001.png"]
    made = {file.name for file in new.rglob("*") if file.is_file()}
    assert made == {f.name for f in path.rglob("*") if f.is_file() and f.suffix != ".mp4"}
    assert not (new / "videos").exists()
    assert (not video) or (path / "videos").exists()


def test_what_a_masking_writes_reads_back(path, tmp_path):
    place, source = tmp_path / "out/dataset/reach", find(path, None, Names())
    write_dataset(source, Names(), None, place, darker)
    for before, after in zip(source.episodes(), find(place, None, Names()).episodes(), strict=True):
        assert np.array_equal(after, darker(before))


def test_what_the_metadata_say_of_the_camera_is_that_of_the_new_frames(path, version, tmp_path):
    new = tmp_path / "new"
    find(path, None, Names()).write(new, darker)
    wanted = [statistics(darker(frames)) for frames in FRAMES]
    if version == "v2.1":
        lines = (new / "meta/episodes_stats.jsonl").read_text().splitlines()
        found = [json.loads(line)["stats"][CAMERA] for line in lines]
    else:
        file = "meta/episodes/chunk-000/file-000.parquet"
        table, before = (pq.read_table(place / file) for place in (new, path))
        start = f"stats/{CAMERA}/"
        found = [
            {key.removeprefix(start): v for key, v in row.items() if key.startswith(start)}
            for row in table.to_pylist()
        ]
        kept = [key for key in before.column_names if CAMERA not in key]
        assert before.select(kept).equals(table.select(kept))
        assert not any(key.startswith("videos/") for key in table.column_names)
        stats = json.loads((new / "meta/stats.json").read_text())
        found.append(stats[CAMERA])
        wanted.append(statistics(darker(np.concatenate(FRAMES))))
        assert stats["action"] == {"min": [-1.0]}
    for one, other in zip(found, wanted, strict=True):
        assert one.keys() == other.keys()
        assert all(np.allclose(one[key], other[key], atol=1e-12) for key in one)


def test_quantiles_are_the_least_level_that_so_many_pixels_do_not_exceed():
    frames = RANDOM.integers(0, 256, (2, 9, 7, 1), dtype=np.uint8)
    made = Levels.of(frames).statistics()
    for percent in (1, 10, 50, 90, 99):
        wanted = np.quantile(frames / 255, percent / 100, method="inverted_cdf")
        assert made[f"q{percent:02d}"] == [[[pytest.approx(wanted, abs=1e-12)]]]


def test_another_camera_keeps_its_video(tmp_path):
    path, new = tmp_path / "reach", tmp_path / "new"
    save(path, "v3.0", True)
    info = json.loads((path / "meta/info.json").read_text())
    info["features"]["observation.images.wrist"] = info["features"][CAMERA]
    (path / "meta/info.json").write_text(json.dumps(info))
    wrist = path / "videos/observation.images.wrist/chunk-000/file-000.mp4"
    wrist.parent.mkdir(parents=True)
    wrist.write_bytes(b"not looked at")
    with pytest.raises(ValueError, match=f"one --frames of {CAMERA}, observation.images.wrist"):
        find(path, None, Names())
    find(path, None, Names(frames=CAMERA)).write(new, darker)
    assert [file.relative_to(new) for file in new.rglob("*.mp4")] == [wrist.relative_to(path)]
    assert json.loads((new / "meta/info.json").read_text())["video_path"] is not None


def cut(name, size):
    def damage(path):
        file = next(path.rglob(name))
        file.write_bytes(file.read_bytes()[:size])

    return damage


def replace(name, text):
    return lambda path: next(path.rglob(name)).write_text(text)


def edit(**changes):
    def damage(path):
        info = json.loads((path / "meta/info.json").read_text())
        info |= changes
        known = {key: value for key, value in info.items() if value != "gone"}
        (path / "meta/info.json").write_text(json.dumps(known))

    return damage


@pytest.mark.parametrize("version", ["v2.1"])
@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (replace("info.json", "{"), "info.json: expected a JSON file, got 1 bytes that are dam"),
        (edit(data_path="gone"), "reach: expected data_path in meta or data, got none"),
        (replace("episodes.jsonl", ""), "reach: expected episodes, got none"),
        (cut("*000001.parquet", 900), "000001.parquet: expected a parquet file, got 900 bytes"),
        (lambda path: next(path.rglob("*2.parquet")).unlink(), "got no file of that name"),
        (
            replace("episodes.jsonl", '{"episode_index": 0, "length": 9, "tasks": []}'),
            "expected 9 rows of 1 episodes in order, as meta says, got 4 rows of 1 episodes",
        ),
    ],
)
def test_what_is_wrong_is_said_in_one_line(path, damage, words):
    damage(path)
    with pytest.raises(ValueError, match=words) as error:
        [*find(path, None, Names()).episodes()]
    assert "\n" not in str(error.value)


def test_a_video_that_is_none_or_too_short_is_named(tmp_path):
    path = tmp_path / "reach"
    save(path, "v3.0", True)
    video = path / f"videos/{CAMERA}/chunk-000/file-000.mp4"
    save_video(video, np.concatenate(FRAMES[:2])[:7])
    with pytest.raises(ValueError, match=r"6 frames of episode 1, 10 a second from 0\.4 s on, got"):
        [*find(path, None, Names()).episodes()]
    video.write_bytes(b"version https://git-lfs.github.com/spec/v1\n")
    with pytest.raises(ValueError, match=r"file-000\.mp4: expected a video, got a Git LFS pointer"):
        find(path, None, Names())


def test_names_that_are_not_there_are_said(path):
    with pytest.raises(ValueError, match=f"expected state, got only {CAMERA}, observation.state"):
        find(path, None, Names(initial_states="state"))
    assert np.array_equal(
        find(path, None, Names(initial_states="action")).initial_states, [a[0] for a in ACTIONS]
    )


@pytest.mark.parametrize("module", ["pyarrow", "av"])
def test_without_its_readers_the_line_to_install_them_is_said(tmp_path, monkeypatch, module):
    save(tmp_path / "reach", "v3.0", True)
    monkeypatch.setitem(__import__("sys").modules, module, None)
    with pytest.raises(
        ValueError, match=rf"expected {module} to.*pip install 'jaxdeconf\[lerobot\]'"
    ):
        find(tmp_path / "reach", None, Names())
