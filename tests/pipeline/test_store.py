"""A run directory: what comes back, and what it refuses."""

import json
import os
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdeconf.learn.fit import start
from jaxdeconf.pipeline import checkpoint
from jaxdeconf.pipeline.plain import write_json
from jaxdeconf.pipeline.store import Store, StoreError, WriteError, free, read_config
from jaxdeconf.presets import PRESETS

CONFIG = PRESETS["cartpole"]["smoke"]


def state():
    params = {"w": jnp.arange(6.0).reshape(2, 3), "b": jnp.ones(3)}
    return start({"params": params, "batch_stats": {}})


def test_what_is_saved_comes_back_with_its_types_and_notes(tmp_path):
    store = Store(tmp_path, CONFIG, resume=False)
    assert store.load("train", state, {}) is None
    store.save("train", 3, state(), {"history": [[0.5, 1.0]], "seconds": 2.0}, {})
    store.save("train", 7, state()._replace(step=jnp.int32(7)), {"history": [], "seconds": 4.0}, {})
    loaded, notes = Store(tmp_path, CONFIG, resume=True).load("train", state, {})
    assert jax.tree.structure(loaded) == jax.tree.structure(state())
    np.testing.assert_array_equal(loaded.variables["params"]["w"], [[0, 1, 2], [3, 4, 5]])
    assert (int(loaded.step), notes) == (7, {"history": [], "seconds": 4.0})


def test_what_comes_back_runs_the_programs_of_what_was_saved(tmp_path):
    """Compiled once: what is committed to a device would be compiled for anew."""
    doubled = jax.jit(lambda state: jax.tree.map(lambda leaf: 2 * leaf, state))
    store = Store(tmp_path, CONFIG, resume=False)
    doubled(state())
    store.save("train", 3, state(), {}, {})
    doubled(store.load("train", state, {})[0])
    assert doubled._cache_size() == 1


@pytest.mark.parametrize(
    "name", ["lr[1e-3]", "a*b?", "back\\slash", "100% {#}", "two\nlines", os.fsdecode(b"\xff")]
)
def test_a_directory_may_have_any_name(tmp_path, name):
    """Patterns, escapes, and what no encoding has."""
    store = Store(tmp_path / name, CONFIG, resume=False)
    for step in (3, 7):
        store.save("train", step, state()._replace(step=jnp.int32(step)), {}, {})
    loaded, _ = Store(tmp_path / name, CONFIG, resume=True).load("train", state, {})
    assert int(loaded.step) == 7


@pytest.mark.parametrize("damage", [lambda array: array + 1, lambda array: array[..., None]])
def test_what_does_not_read_back_as_it_was_is_not_saved(tmp_path, monkeypatch, damage):
    store = Store(tmp_path, CONFIG, resume=False)
    store.save("train", 3, state(), {}, {})
    savez = np.savez

    def damaged(file, **arrays):
        savez(file, **{name: damage(array) for name, array in arrays.items()})

    monkeypatch.setattr(np, "savez", damaged)
    with pytest.raises(WriteError, match=r"train/7: .*what was written does not read back"):
        store.save("train", 7, state(), {}, {})
    monkeypatch.setattr(np, "savez", lambda file, **_: file.write_bytes(b""))
    with pytest.raises(WriteError, match=r"train/7: .*what was written does not read back"):
        store.save("train", 7, state(), {}, {})
    assert [path.name for path in (tmp_path / "checkpoints/train").iterdir()] == ["3"]
    assert store.load("train", state, {}) is not None


def test_the_config_comes_back_as_it_was(tmp_path):
    for name, config in [*PRESETS["cartpole"].items(), *PRESETS["reacher"].items()]:
        directory = tmp_path / config.system / name
        Store(directory, config, resume=False)
        assert read_config(directory) == config


def test_a_run_is_not_resumed_with_another_config(tmp_path):
    Store(tmp_path, CONFIG, resume=False)
    other = replace(CONFIG, disentangle=replace(CONFIG.disentangle, beta=9.0))
    with pytest.raises(StoreError, match=r"another config: --disentangle.beta was 2.0, is 9.0"):
        Store(tmp_path, other, resume=True)


def test_nothing_to_resume(tmp_path):
    with pytest.raises(StoreError, match=r"config.json: no run to resume there"):
        Store(tmp_path, CONFIG, resume=True)


def test_a_place_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(StoreError, match=r"file/run: cannot be written"):
        Store(tmp_path / "file" / "run", CONFIG, resume=False)


def test_a_checkpoint_of_something_else_is_named_and_kept(tmp_path):
    store = Store(tmp_path, CONFIG, resume=False)
    store.save("train", 3, state(), {}, {})
    with pytest.raises(StoreError, match=r"train/3: not a checkpoint of this run .*delete"):
        store.load("train", lambda: {"other": jnp.zeros(2)}, {})
    assert store.load("train", state, {}) is not None


def test_out_of_memory_and_faults_of_ours_are_not_blamed_on_the_files(tmp_path, monkeypatch):
    """Else half an hour's training would be deleted on our advice."""
    store = Store(tmp_path, CONFIG, resume=False)
    store.save("train", 3, state(), {}, {})

    def fails(error):
        def fail(*_):
            raise error

        return fail

    for error in (MemoryError(), jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: 1 GB")):
        with monkeypatch.context() as patch:
            patch.setattr(checkpoint, "read_state", fails(error))
            with pytest.raises(type(error)):
                store.load("train", state, {})
        with monkeypatch.context() as patch:
            patch.setattr(checkpoint, "write", fails(error))
            with pytest.raises(type(error)):
                store.save("train", 4, state(), {}, {})
    with pytest.raises(ZeroDivisionError):
        store.load("train", fails(ZeroDivisionError()), {})
    with monkeypatch.context() as patch:
        patch.setattr(checkpoint, "write", fails(ValueError("a bug")))
        with pytest.raises(ValueError, match=r"^a bug$"):
            store.save("train", 4, state(), {}, {})
    assert store.load("train", state, {}) is not None


def test_a_disk_that_is_full_is_said_to_be(tmp_path, monkeypatch):
    store = Store(tmp_path, CONFIG, resume=False)

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(checkpoint, "write", full)
    with pytest.raises(WriteError, match=r"No space left on device\); see to the disk"):
        store.save("train", 3, state(), {}, {})


def test_json_is_replaced_in_one_step(tmp_path):
    file = tmp_path / "a.json"
    write_json(file, {"x": jnp.arange(3), "y": (np.float32(0.5), True, None, float("nan"))})
    assert json.loads(file.read_text()) == {"x": [0, 1, 2], "y": [0.5, True, None, None]}
    with pytest.raises(TypeError):
        write_json(file, {"x": object()})
    assert json.loads(file.read_text())["x"] == [0, 1, 2]


def test_a_run_of_the_version_before_is_refused_in_one_line(tmp_path):
    plain = {"jaxdeconf": "0.1.0", "system": "cartpole", "vae": {"epochs": 2}}
    (tmp_path / "config.json").write_text(json.dumps(plain))
    words = r"config.json: a run of jaxdeconf 0\.1\.0, not of this version"
    with pytest.raises(StoreError, match=words) as error:
        read_config(tmp_path)
    assert "\n" not in str(error.value)


def test_a_run_goes_on_in_the_precision_that_it_was_begun_with(tmp_path):
    Store(tmp_path, CONFIG, resume=False).save("train", 3, state(), {}, {})
    file = tmp_path / "config.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"x64": True}))
    words = r"config.json: a run begun with JAX_ENABLE_X64=1, which is 0 now; go on with what "
    with pytest.raises(StoreError, match=words) as error:
        Store(tmp_path, CONFIG, resume=True)
    assert "delete" not in str(error.value)


def test_a_start_that_saved_nothing_leaves_no_claim(tmp_path):
    """Another config takes its place, also after a kill in the first save."""
    Store(tmp_path, CONFIG, resume=False)
    killed = tmp_path / "checkpoints" / "collect" / "0.partial"
    killed.mkdir(parents=True)
    (killed / "arrays.npz").write_bytes(b"half")
    assert free(tmp_path)
    other = replace(CONFIG, seed=9)
    store = Store(tmp_path, other, resume=False)
    assert read_config(tmp_path) == other
    store.save("collect", 0, state(), {}, {})
    assert not free(tmp_path)
    with pytest.raises(StoreError, match="holds a run; use --resume"):
        Store(tmp_path, CONFIG, resume=False)


@pytest.mark.parametrize("name", ["config.json", "notes.txt", "deep/er/file"])
def test_a_file_of_ones_own_is_no_claim_of_ours(tmp_path, name):
    (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / name).write_text('{"mine": 1}')
    with pytest.raises(StoreError, match=r"holds a run|is no run's"):
        Store(tmp_path, CONFIG, resume=False)
    assert (tmp_path / name).read_text() == '{"mine": 1}'
