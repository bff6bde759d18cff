"""A LeRobot folder written again: the camera's frames anew, and what the metadata say of them."""

import contextlib
import json
import shutil
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any

from jaxdeconf.formats import pixels
from jaxdeconf.formats.lerobot.layout import (
    INFO,
    Opened,
    frames,
    parquet_files,
    read_json_lines,
)
from jaxdeconf.formats.lerobot.levels import Levels
from jaxdeconf.formats.source import Redraw, read_json

_TOTAL = Path("meta/stats.json")
_PER_EPISODE = Path("meta/episodes_stats.jsonl")  # v2.1's; v3 has them in the rows of episodes


def write(opened: Opened, to: Path, redraw: Redraw) -> None:
    """Copies the folder; what holds the camera's frames, and what is said of them, is made anew."""
    path, camera, met = opened.path, opened.camera, {}
    info = _with_images_only(opened) if opened.is_video else opened.info
    gone = {camera} if info["video_path"] else {camera, "videos"}

    def skipped(_: str, names: list[str]) -> set[str]:
        return gone & {*names} if opened.is_video else set()

    def drawn() -> Iterator[bytes]:
        for episode, stored in zip(opened.episodes, frames(opened), strict=True):
            new = pixels.redrawn(camera, stored, redraw)
            met[episode.index] = Levels.of(new)
            yield from map(pixels.png, new)

    shutil.copytree(path, to, ignore=skipped, copy_function=shutil.copyfile)
    images = drawn()
    for name in opened.files:
        _rewrite(path / name, to / name, lambda table: _with_images(opened, table, images))
    _write_statistics(opened, to, met)
    if opened.is_video:
        (to / INFO).write_text(json.dumps(info, indent=4), encoding="utf-8")


def _write_statistics(opened: Opened, to: Path, met: dict[int, Levels]) -> None:
    """The camera's, wherever they are kept."""
    path, camera = opened.path, opened.camera
    for name in parquet_files(path):
        _rewrite(path / name, to / name, lambda table: _with_statistics(table, camera, met))
    if (path / _PER_EPISODE).exists():
        lines = read_json_lines(path / _PER_EPISODE)
        for line in lines:
            line["stats"] |= _renewed(line["stats"], camera, met[line["episode_index"]])
        text = "".join(json.dumps(line) + "\n" for line in lines)
        (to / _PER_EPISODE).write_text(text, encoding="utf-8")
    if (path / _TOTAL).exists():
        stats = read_json(path / _TOTAL)
        stats |= _renewed(stats, camera, Levels.together(met.values()))
        (to / _TOTAL).write_text(json.dumps(stats, indent=4), encoding="utf-8")


def _rewrite(path: Path, to: Path, change: Callable[[Any], Any]) -> None:
    """Writes a parquet file with its tables changed, a group of rows after another."""
    import pyarrow.parquet as pq

    with pq.ParquetFile(path) as file, contextlib.ExitStack() as stack:
        writer = None
        for group in range(file.num_row_groups):
            table = change(file.read_row_group(group))
            writer = writer or stack.enter_context(pq.ParquetWriter(to, table.schema))
            writer.write_table(table)


def _with_images(opened: Opened, table: Any, files: Iterator[bytes]) -> Any:
    """Rows with the next images; of a camera that was a video, in a column where it belongs."""
    import pyarrow as pa

    camera, keys, names = opened.camera, [*opened.info["features"]], table.column_names
    if there := camera in names:
        paths = table[camera].combine_chunks().field("path")
    else:  # as LeRobot calls them
        paths = pa.array([f"frame-{at:06d}.png" for at in table["frame_index"].to_pylist()])
    images = pa.array(islice(files, len(table)), pa.binary())
    column = pa.StructArray.from_arrays([images, paths], ["bytes", "path"])
    if there:
        return table.set_column(names.index(camera), camera, column)
    before = {*keys[: keys.index(camera)]} & {*names}
    new = table.add_column(len(before), camera, column)
    about = dict(table.schema.metadata or {})
    if b"huggingface" in about:  # what `datasets` calls the columns
        known = json.loads(about[b"huggingface"])
        types = known["info"]["features"]
        known["info"]["features"] = {
            key: types.get(key, {"_type": "Image"}) for key in new.column_names
        }
        about[b"huggingface"] = json.dumps(known).encode()
    return new.replace_schema_metadata(about)


def _with_statistics(table: Any, camera: str, met: dict[int, Levels]) -> Any:
    """v3's rows of episodes, with new statistics of the camera, and no place in a video."""
    import pyarrow as pa

    gone = [key for key in table.column_names if key.startswith(f"videos/{camera}/")]
    table = table.drop_columns(gone)
    found = [met[index].statistics() for index in table["episode_index"].to_pylist()]
    for what in found[0]:
        if (key := f"stats/{camera}/{what}") in table.column_names:
            field = table.schema.field(key)
            values = pa.array([one[what] for one in found], field.type)
            table = table.set_column(table.column_names.index(key), field, values)
    return table


def _renewed(stats: dict[str, Any], camera: str, met: Levels) -> dict[str, Any]:
    """A camera's statistics, of those kinds that were there."""
    old, new = stats.get(camera, {}), met.statistics()
    return {camera: {key: new.get(key, value) for key, value in old.items()}} if old else {}


def _with_images_only(opened: Opened) -> dict[str, Any]:
    """meta/info.json of a dataset in which the camera is no video any more."""
    info, camera = opened.info, opened.camera
    kept = {key: info["features"][camera][key] for key in ("shape", "names")}
    features = info["features"] | {camera: {"dtype": "image", **kept}}
    left = any(feature["dtype"] == "video" for feature in features.values())
    new = info | {"features": features, "video_path": info["video_path"] if left else None}
    if "total_videos" in info:  # v2
        new["total_videos"] = info["total_videos"] - len(opened.episodes)
    return new
