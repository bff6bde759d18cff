"""The rows of a sweep on disk."""

import json

import pytest

from jaxdeconf.pipeline.config import Config
from jaxdeconf.pipeline.grid import Axis
from jaxdeconf.pipeline.store import StoreError, WriteError
from jaxdeconf.pipeline.sweep_log import Log, Sweep, read_sweep, require_same, write_sweep

SWEEP = Sweep(Config(), (Axis("vae.network.channels", ((4, 8), (8, 16))),), 2, ("Masked",))


def row(point):
    return {"point": point, "values": {"seed": point}}


def test_a_sweep_is_read_as_it_was_written(tmp_path):
    write_sweep(tmp_path, SWEEP)
    assert read_sweep(tmp_path) == SWEEP
    require_same(tmp_path, SWEEP)
    assert [path.name for path in tmp_path.iterdir()] == ["sweep.json"]


def test_the_first_of_many_writers_wins(tmp_path):
    write_sweep(tmp_path, SWEEP)
    write_sweep(tmp_path, Sweep(Config()))
    assert read_sweep(tmp_path) == SWEEP
    with pytest.raises(StoreError, match="holds another sweep"):
        require_same(tmp_path, Sweep(Config()))


def test_rows_of_all_shards_are_read_by_point(tmp_path):
    Log(tmp_path, (2, 2)).append([row(3), row(2)])
    Log(tmp_path, (1, 2)).append([row(0)])
    Log(tmp_path).append([row(1)])
    assert Log(tmp_path, (1, 2)).rows() == [row(point) for point in range(4)]


def test_a_half_written_line_is_no_row_and_is_cut_off(tmp_path):
    log = Log(tmp_path)
    log.append([row(0), row(1)])
    whole = (tmp_path / "sweep.jsonl").read_bytes()
    (tmp_path / "sweep.jsonl").write_bytes(whole + b'{"point": 2, "val')
    assert log.rows() == [row(0), row(1)]
    log.mend()
    assert (tmp_path / "sweep.jsonl").read_bytes() == whole
    log.append([row(2)])
    assert log.rows() == [row(0), row(1), row(2)]


@pytest.mark.parametrize("line", ["{", "[]", '{"values": {}}', "7"])
def test_a_damaged_row_is_named(tmp_path, line):
    (tmp_path / "sweep.jsonl").write_text(json.dumps(row(0)) + "\n" + line + "\n")
    with pytest.raises(StoreError, match=r"sweep\.jsonl: line 2 is no row of a sweep"):
        Log(tmp_path).rows()


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"jaxdeconf": "0.0.1"}'])
def test_a_damaged_plan_is_named(tmp_path, text):
    (tmp_path / "sweep.json").write_text(text)
    with pytest.raises(StoreError, match=r"sweep\.json: not a sweep of jaxdeconf"):
        read_sweep(tmp_path)


def test_a_disk_that_takes_no_row_is_named(tmp_path):
    with pytest.raises(WriteError, match=r"go on with --resume"):
        Log(tmp_path / "gone").append([row(0)])


@pytest.mark.parametrize(("field", "value"), [("seeds", 0), ("policies", ("Copycat",))])
def test_a_bad_sweep_names_the_field(field, value):
    with pytest.raises(ValueError, match=f"{field}: expected "):
        Sweep(Config(), **{field: value})
