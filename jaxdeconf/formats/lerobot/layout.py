"""What lies in a LeRobot folder: its episodes, its numbers, and its frames an episode at a time."""

import contextlib
import json
from collections.abc import Iterator, Sequence
from itertools import groupby, islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxdeconf.formats import pixels
from jaxdeconf.formats.source import library, reading

INFO = Path("meta/info.json")
_EXTRA = "lerobot"


class Episode(NamedTuple):
    """Where one is."""

    index: int
    length: int
    rows: Path  # the parquet file that holds them, as all paths here, within the dataset
    video: Path | None
    start: int  # of its first frame in the video


class Opened(NamedTuple):
    """A dataset of which one camera is taken."""

    path: Path
    info: dict[str, Any]
    camera: str
    episodes: list[Episode]  # in the order of their frames

    @property
    def is_video(self) -> bool:
        """Whether the camera's frames are in videos, or images in the rows."""
        return self.info["features"][self.camera]["dtype"] == "video"

    @property
    def files(self) -> list[Path]:
        """The parquet files of all frames, in order."""
        return list(dict.fromkeys(episode.rows for episode in self.episodes))


def read_json_lines(path: Path) -> list[dict[str, Any]]:
    """What each line of a file holds."""
    with reading(path, "lines of JSON", json.JSONDecodeError):
        lines = path.read_text(encoding="utf-8").splitlines()
        return [json.loads(line) for line in lines if line.strip()]


def episodes(path: Path, info: dict[str, Any], camera: str) -> list[Episode]:
    """The episodes, by their number."""
    found, video = [], info["features"][camera]["dtype"] == "video"
    for row in sorted(_rows(path), key=lambda row: row["episode_index"]):
        index, length, of_video = row["episode_index"], int(row["length"]), f"videos/{camera}"
        rows = _place(info, info["data_path"], row, "data", camera)
        shown = _place(info, info["video_path"], row, of_video, camera) if video else None
        start = round(row.get(f"{of_video}/from_timestamp", 0.0) * info["fps"])
        found.append(Episode(index, length, rows, shown, start))
    if not found:
        raise ValueError(f"{path}: expected episodes, got none")
    return found


def _place(info: dict[str, Any], template: str, row: dict[str, Any], of: str, camera: str) -> Path:
    """The file that a template names: v3 says which in the row, v2 by the episode's number."""
    index = row["episode_index"]
    return Path(
        template.format(
            chunk_index=row.get(f"{of}/chunk_index", 0),
            file_index=row.get(f"{of}/file_index", 0),
            episode_chunk=index // info["chunks_size"],
            episode_index=index,
            video_key=camera,
        )
    )


def _rows(path: Path) -> list[dict[str, Any]]:
    """What the metadata say of each episode, without statistics."""
    if not (path / "meta/episodes").is_dir():
        return read_json_lines(path / "meta/episodes.jsonl")
    found = []
    for name in parquet_files(path):
        with _parquet(path, name) as file:
            wanted = [key for key in file.schema_arrow.names if not key.startswith("stats/")]
            found += file.read(columns=wanted).to_pylist()
    return found


def parquet_files(path: Path) -> list[Path]:
    """v3's files of episodes."""
    return [file.relative_to(path) for file in sorted((path / "meta/episodes").rglob("*.parquet"))]


@contextlib.contextmanager
def _parquet(path: Path, name: Path) -> Iterator[Any]:
    """An opened parquet file."""
    pa, pq = (library(path, module, _EXTRA) for module in ("pyarrow", "pyarrow.parquet"))
    kind = "a parquet file"
    with reading(path / name, kind, pa.ArrowException), pq.ParquetFile(path / name) as file:
        yield file


def numbers(opened: Opened, keys: Sequence[str]) -> dict[str, np.ndarray]:
    """{feature: [n, A]}, of all frames.

    Raises:
      ValueError: if the rows are not those of the episodes, one after another.
    """
    parts: dict[str, list[np.ndarray]] = {key: [] for key in (*keys, "episode_index")}
    for name in opened.files:
        with _parquet(opened.path, name) as file:
            table = file.read(columns=[*parts])
            for key, into in parts.items():
                into.append(_flat(table[key].combine_chunks()))
    found = {key: np.concatenate(some) for key, some in parts.items()}
    rows, episodes = found.pop("episode_index").ravel(), opened.episodes
    wanted = np.repeat([one.index for one in episodes], [one.length for one in episodes])
    if not np.array_equal(rows, wanted):
        raise ValueError(
            f"{opened.path}: expected {len(wanted)} rows of {len(episodes)} episodes in order, as "
            f"meta says, got {len(rows)} rows of {len(np.unique(rows))} episodes"
        )
    return found


def _flat(array: Any) -> np.ndarray:
    """[n, A] of a column of numbers, or of lists of them."""
    flat = array.flatten() if array.type.num_fields else array
    return flat.to_numpy(zero_copy_only=False).reshape(len(array), -1)


def frames(opened: Opened) -> Iterator[np.ndarray]:
    """uint8 [T, H, W, C] of each episode."""
    if opened.is_video:
        yield from _video(opened)
        return
    for name, episodes in groupby(opened.episodes, key=lambda episode: episode.rows):
        with _parquet(opened.path, name) as file:
            where = f"{opened.path / name}: {opened.camera}"
            files = _images(where, file, opened.camera)
            for episode in episodes:
                yield pixels.decoded(where, islice(files, episode.length))


def _images(where: str, file: Any, camera: str) -> Iterator[bytes]:
    """The image files in the rows."""
    for batch in file.iter_batches(batch_size=64, columns=[camera]):
        for stored in batch.column(0).field("bytes").to_pylist():
            if stored is None:
                raise ValueError(f"{where}: expected images in the rows, got their paths only")
            yield stored


def _video(opened: Opened) -> Iterator[np.ndarray]:
    """RGB frames, each by its time."""
    av, rate = library(opened.path, "av", _EXTRA), opened.info["fps"]
    for name, episodes in groupby(opened.episodes, key=lambda episode: episode.video):
        assert name is not None
        place = opened.path / name
        with reading(place, "a video", av.FFmpegError), av.open(str(place)) as container:
            images = ((_time(image, rate), image) for image in container.decode(video=0))
            for episode in episodes:
                left = (one for one in images if one[0] >= episode.start)
                some = [*islice(left, episode.length)]
                wanted = range(episode.start, episode.start + episode.length)
                if [time for time, _ in some] != [*wanted]:
                    raise ValueError(
                        f"{place}: expected {episode.length} frames of episode {episode.index}, "
                        f"{rate} a second from {episode.start / rate:g} s on, got {len(some)}"
                    )
                yield np.stack([image.to_ndarray(format="rgb24") for _, image in some])


def _time(image: Any, rate: float) -> int:
    """A frame's time, in frames."""
    return round(float(image.pts * image.time_base * rate))
