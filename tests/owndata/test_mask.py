"""`jaxdeconf mask` on a made-up scene: two blobs that matter, and a corner that shows the past."""

import json
import shutil
import sys
import types
import zipfile
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxdeconf as jd
from jaxdeconf.commands import mask as command
from jaxdeconf.commands import report
from jaxdeconf.learn.disentangle import Encoder
from jaxdeconf.nets import vae
from jaxdeconf.nets.vae import VAEConfig
from jaxdeconf.owndata import dataset, judge, run
from jaxdeconf.owndata.clones import Clone
from jaxdeconf.owndata.view import make_view, save_view
from jaxdeconf.report import owndata
from tests.owndata.scene import CONFIG, scene

SMALL = (
    *("--size", "32", "--disentangle.steps", "64", "--disentangle.chunk", "32"),
    *("--disentangle.network.channels", "4", "4", "--disentangle.network.norm", "none"),
    *("--disentangle.network.latents", "3", "--disentangle.start-components", "3"),
)


@pytest.fixture(scope="module")
def masked(tmp_path_factory):
    """A whole masking through the command, whose cache of programs the others share."""
    place = tmp_path_factory.mktemp("masked")
    np.savez_compressed(place / "demos.npz", **scene(400, 4, True, 0))
    np.savez_compressed(place / "more.npz", **scene(150, 6, False, 1))
    words = [str(place / "demos.npz"), "--exploration", str(place / "more.npz")]
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(place / "cache"))
        code = command.main([*words, "--out", str(place / "out"), *SMALL])
    assert code == 0
    return place


def arrays_of(path):
    with np.load(path) as arrays:
        return {name: arrays[name] for name in arrays.files}


def test_the_corner_and_nothing_else_is_gone_from_the_written_frames(masked):
    """Reference: the frames that were drawn. All else is copied to the byte."""
    old, new = (arrays_of(masked / where) for where in ("demos.npz", "out/dataset/demos.npz"))
    corner = np.zeros((32, 32), bool)
    corner[22:30, 22:30] = True
    around = np.zeros((32, 32), bool)
    around[18:, 18:] = True
    differ = (old["frames"] != new["frames"]).any(axis=(0, 3))
    assert differ[corner].all()
    assert not differ[~around].any()
    assert new["frames"][:, corner].astype(float).std() < 0.1 * old["frames"][:, corner].std()
    places = masked / "demos.npz", masked / "out/dataset/demos.npz"
    with zipfile.ZipFile(places[0]) as a, zipfile.ZipFile(places[1]) as b:
        assert a.namelist() == b.namelist()
        for name in a.namelist():
            assert name == "frames.npy" or a.read(name) == b.read(name)


def test_the_results_say_what_was_found(masked):
    found = json.loads((masked / "out/results.json").read_text())
    assert found["refused"] is None
    assert sum(found["mask"]) == 1
    chosen = found["mask"].index(True)
    assert found["nuisance_share"][chosen] > 0.95
    assert found["spread"][chosen] == pytest.approx(1.0, abs=0.2)
    assert found["stability"][chosen] > 0.9
    assert found["leakage"]["raw"] > 0.95
    assert found["leakage"]["written"] < 0.05
    assert set(found["retention"]) == {"left", "right"}
    for raw, written in found["retention"].values():
        assert written > 0.95 * raw > 0.9
    written = found["written"]
    assert written["mode"] == "inpaint"
    assert written["size"] == [32, 32]
    assert 64 <= written["region_pixels"] <= 196
    assert found["check"]["state_names"] == ["left", "right"]
    assert {"read", "check", "disentangle", "mask", "judge", "write"} <= set(found["seconds"])
    assert (masked / "out/figures/dependence.png").exists()
    page = (masked / "out/report.html").read_text()
    assert page.index("masked.") < page.index("<h2>Figures")  # the verdict comes first


def test_its_report_is_drawn_again_from_its_directory(masked, capsys):
    page, strip = masked / "out/report.html", masked / "out/figures/frames.png"
    before = page.read_bytes(), strip.read_bytes()
    page.unlink()
    strip.unlink()
    assert report.main([str(masked / "out")]) == 0
    assert capsys.readouterr().out == f"report: {page}\n"
    assert (page.read_bytes(), strip.read_bytes()) == before
    assert b"polic" not in before[0].partition(b"<h2>Figures")[2].partition(b"<h2>What was")[0]


def test_the_view_makes_of_a_frame_what_was_written(masked):
    view = jd.load_view(masked / "out")
    old, new = (arrays_of(masked / where) for where in ("demos.npz", "out/dataset/demos.npz"))
    before, after = old["frames"][:70], new["frames"][:70]
    assert np.array_equal(view(before), after)
    assert np.array_equal(view(before[3]), after[3])
    assert isinstance(view(before[3]), np.ndarray)
    with pytest.raises(ValueError, match=r"frames: expected uint8 of shape \[H, W, 3\]"):
        view(before.astype(float))


def test_the_view_takes_frames_of_another_size(masked):
    """Reference: every pixel of a frame three times as large, where nothing is redrawn."""
    view = jd.load_view(masked / "out/view")
    frame = arrays_of(masked / "demos.npz")["frames"][0]
    large = frame.repeat(3, axis=0).repeat(3, axis=1)
    seen = view(large)
    region = view.region.repeat(3, axis=0).repeat(3, axis=1)
    assert np.array_equal(seen[~region], large[~region])
    assert np.array_equal(dataset.fitted(seen[None], 32)[0][~view.region], frame[~view.region])


def told_by_the_docs(library):
    """What the page's own lines define, of the block that imports from a library."""
    page = Path(__file__).parents[2].joinpath("docs/own-data.md").read_text(encoding="utf-8")
    blocks = [part for part in page.split("```") if part.startswith("python\nimport")]
    (block,) = [part for part in blocks if library in part]
    told = {}
    exec(block.removeprefix("python"), told)
    return told


def floats(frame):
    """A frame as robomimic and LeRobot show it."""
    return np.moveaxis(frame, -1, 0).astype(np.float32) / 255


def test_the_wrapper_of_the_docs_runs(masked):
    """Around an environment that shows frames of the dataset."""
    gymnasium = pytest.importorskip("gymnasium")
    frames = arrays_of(masked / "demos.npz")["frames"]

    class Camera(gymnasium.Env):
        observation_space = gymnasium.spaces.Box(0, 255, frames.shape[1:], np.uint8)
        action_space = gymnasium.spaces.Discrete(2)

        def reset(self, **_):
            return frames[0], {}

        def step(self, _):
            return frames[1], 0.0, False, False, {}

    view, wrapper = jd.load_view(masked / "out"), told_by_the_docs("gymnasium")["Masked"]
    env = wrapper(Camera(), masked / "out")
    assert np.array_equal(env.reset()[0], view(frames[0]))
    assert np.array_equal(env.step(0)[0], view(frames[1]))


def test_the_wrapper_for_robomimic_runs(masked, monkeypatch):
    """Around what its EnvWrapper asks of an environment."""

    class EnvWrapper:
        def __init__(self, env):
            self.env = env

    class Camera:
        def reset(self):
            return {"image": floats(frames[0]), "joints": 7}

        def step(self, action):
            return {"image": floats(frames[action])}, 0.5, True, {}

    wrappers = types.ModuleType("robomimic.envs.wrappers")
    wrappers.EnvWrapper = EnvWrapper  # type: ignore
    monkeypatch.setitem(sys.modules, "robomimic.envs.wrappers", wrappers)
    for package in ("robomimic", "robomimic.envs"):
        monkeypatch.setitem(sys.modules, package, types.ModuleType(package))
    frames, view = arrays_of(masked / "demos.npz")["frames"], jd.load_view(masked / "out")
    env = told_by_the_docs("robomimic")["MaskedEnv"](Camera(), masked / "out", "image")
    shown = env.reset()
    assert shown["joints"] == 7
    assert np.array_equal(shown["image"], floats(view(frames[0])))
    shown, *rest = env.step(3)
    assert np.array_equal(shown["image"], floats(view(frames[3])))
    assert rest == [0.5, True, {}]


def test_the_step_for_lerobot_runs(masked, monkeypatch):
    """On batches as its pipelines hand them on; of the library only the base class is made up."""
    torch = pytest.importorskip("torch")
    processor = types.ModuleType("lerobot.processor")
    processor.ObservationProcessorStep = object  # type: ignore
    monkeypatch.setitem(sys.modules, "lerobot", types.ModuleType("lerobot"))
    monkeypatch.setitem(sys.modules, "lerobot.processor", processor)
    frames, view = arrays_of(masked / "demos.npz")["frames"][:2], jd.load_view(masked / "out")
    step = told_by_the_docs("lerobot")["MaskCamera"](masked / "out", "top")
    images = torch.from_numpy(np.stack([*map(floats, frames)]))
    for given, seen in ((images, frames), (images[0], frames[:1])):
        shown = step.observation({"top": given})["top"]
        assert shown.shape == given.shape
        assert np.allclose(shown.numpy(), np.stack([*map(floats, view(seen))]))


@pytest.mark.parametrize("whole", [False, True])
def test_a_saved_view_draws_the_same(tmp_path, whole):
    """Reference: the same view before it was saved; a whole frame is drawn by the β-VAE."""
    network = VAEConfig(channels=(2,), latents=3, norm="none")
    variables = vae.init(network, jax.random.key(1), (32, 32))
    encoder = Encoder(network, variables, jnp.ones(3), jnp.ones(3, bool))
    region = jnp.ones((32, 32), bool) if whole else jnp.arange(32)[:, None] < jnp.arange(32)
    made = make_view(encoder, jnp.array([False, True, False]), region)
    save_view(tmp_path / "view", made)
    loaded = jd.load_view(tmp_path)
    frames = np.random.default_rng(0).integers(0, 256, (3, 32, 48, 3), np.uint8)
    seen = loaded(frames)
    assert loaded.local is not whole
    assert np.array_equal(seen, made(frames))
    assert np.array_equal(seen[1], loaded(frames[1]))
    assert ((seen == seen[0]) | (seen == frames)).all() != whole


def test_a_damaged_view_is_named(masked, tmp_path):
    with pytest.raises(ValueError, match=r"expected a view of jaxdeconf mask, got"):
        jd.load_view(tmp_path)
    (tmp_path / "view.json").write_bytes((masked / "out/view/view.json").read_bytes())
    (tmp_path / "arrays.npz").write_bytes(b"PK\x03\x04 and no more")
    with pytest.raises(ValueError, match=r"expected a view of jaxdeconf mask, got"):
        jd.load_view(tmp_path)


def test_a_view_that_draws_otherwise_is_refused(masked, tmp_path):
    """As a version before 0.7.0 left it."""
    about = json.loads((masked / "out/view/view.json").read_text(encoding="utf-8"))
    del about["form"]
    (tmp_path / "view.json").write_text(json.dumps(about))
    with pytest.raises(ValueError, match=r"got one of another version, .*: mask the data again$"):
        jd.load_view(tmp_path)


def test_what_is_finished_is_only_said_again(masked, capsys):
    before = (masked / "out/results.json").stat().st_mtime_ns
    assert command.main(["--resume", str(masked / "out")]) == 0
    assert "The previous action explains" in capsys.readouterr().out
    assert (masked / "out/results.json").stat().st_mtime_ns == before


def test_it_goes_on_from_what_was_trained(masked, tmp_path, capsys):
    """Killed before it wrote anything, it trains no step again and writes the same bytes."""
    for name in ("config.json", "checkpoints"):
        source = masked / "out" / name
        for file in [source] if source.is_file() else source.rglob("*"):
            if file.is_file():
                copy = tmp_path / file.relative_to(masked / "out")
                copy.parent.mkdir(parents=True, exist_ok=True)
                copy.write_bytes(file.read_bytes())
    (tmp_path / "dataset.partial").mkdir()
    (tmp_path / "dataset.partial/demos.npz").write_bytes(b"half")
    assert command.main(["--resume", str(tmp_path)]) == 0
    assert "disentangle" not in capsys.readouterr().err
    name = "dataset/demos.npz"
    assert (tmp_path / name).read_bytes() == (masked / "out" / name).read_bytes()
    assert not (tmp_path / "dataset.partial").exists()


def test_the_output_is_not_overwritten_and_not_resumed_otherwise(masked, capsys):
    demos, out = str(masked / "demos.npz"), str(masked / "out")
    assert command.main([demos, "--out", out]) == 2
    assert "holds a run; use --resume" in capsys.readouterr().err
    assert command.main(["--resume", out, "--seed", "3"]) == 2
    assert "--seed was 0, is 3" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([], "DEMOS: expected the demonstrations, a file or a folder, got none"),
        (["nowhere.npz"], "nowhere.npz: expected a dataset, got no file or folder"),
        (["demos.npz", "--states", "middle"], "states: expected one of left, right, got 'middle'"),
        (
            ["demos.npz", "--horizon", "4"],
            "horizon: expected at most 3, the steps of episode 1; --drop-short 4",
        ),
        (["demos.npz", "--drop-short", "9"], "drop_short: expected at most 4, no episode has 9"),
        (["demos.npz", "--size", "33"], "size: expected multiples of 32"),
        (["demos.npz", "--exploration", "wide.npz"], "wide.npz: expected frames of 32 × 32, got"),
        (["few.npz"], "episodes: expected an integer >= 5, got 4"),
        ([".", "--out", "within"], "--out: expected a place outside of ."),
    ],
)
def test_what_cannot_be_done_exits_with_2_and_one_line(masked, monkeypatch, capsys, words, said):
    """And nothing is left where it would have gone."""
    monkeypatch.chdir(masked)
    few = scene(4, 4, True, 5)
    np.savez(masked / "few.npz", **few)
    np.savez(masked / "wide.npz", **few | {"frames": few["frames"].repeat(2, axis=2)})
    assert command.main([*words, "--check"]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1
    assert not (masked / "within").exists()


def test_check_says_what_moves_the_actions_and_writes_nothing(masked, capsys):
    words = [str(masked / "demos.npz"), "--exploration", str(masked / "more.npz"), "--check"]
    before = set(masked.rglob("*"))
    assert command.main([*words, *SMALL]) == 0
    said = capsys.readouterr().out
    assert "demonstrations: frames 32 × 32, 400 episodes of 3 to 4 steps" in said
    assert "States that move the actions: left from step 1 on, right from step 1 on" in said
    assert {path for path in masked.rglob("*") if "cache" not in path.parts} <= before


def test_with_few_episodes_the_previous_action_must_agree():
    """What is masked because its state is not seen to move anything stays."""
    mask, share = np.array([True, True, False]), np.array([0.99, 0.01, 0.5])
    assert judge.confirmed(mask, share, 600, CONFIG).tolist() == [True, True, False]
    assert judge.confirmed(mask, share, 150, CONFIG).tolist() == [True, False, False]
    always = replace(CONFIG, min_power=0.9)
    assert judge.confirmed(mask, share, 150, always).tolist() == [True, True, False]


def test_the_words_of_a_kept_latent_name_the_number_of_episodes(masked):
    from jaxdeconf.owndata.results import Found
    from jaxdeconf.pipeline import results

    found, _ = results.load(masked / "out", Found)
    asked = np.ones_like(found.mask)
    said = " ".join(owndata.verdict(found._replace(asked=asked)))
    assert "Algorithm 1 would have masked" in said
    assert "400 episodes show only correlations" in said
    assert owndata.summary(found, Path("out")).endswith("report: out/report.html")


def resumed(masked, tmp_path, monkeypatch, chosen):
    """The exit code of a masking that is killed before it masks, and then asked to mask so."""
    shutil.copytree(masked / "out/checkpoints", tmp_path / "checkpoints")
    shutil.copy(masked / "out/config.json", tmp_path)
    monkeypatch.setattr(judge, "confirmed", lambda mask, *_: np.full_like(mask, chosen))
    return command.main(["--resume", str(tmp_path)])


def test_where_all_would_be_masked_nothing_is_written(masked, tmp_path, monkeypatch, capsys):
    assert resumed(masked, tmp_path, monkeypatch, True) == 1
    said = capsys.readouterr()
    assert "every latent would be masked, and nothing would be left of the frames" in said.err
    assert "Nothing was written: every latent" in said.out
    assert not (tmp_path / "dataset").exists()
    assert not (tmp_path / "view").exists()


def test_where_nothing_is_to_be_masked_that_is_a_finding(masked, tmp_path, monkeypatch, capsys):
    assert resumed(masked, tmp_path, monkeypatch, False) == 0
    assert "none masked" in capsys.readouterr().out
    assert not (tmp_path / "dataset").exists()


def test_clones_are_compared_where_that_is_asked_for(masked, tmp_path, monkeypatch):
    def compared(demos, out, view, *_, together):
        assert together([lambda: 1, lambda: 2]) == [1, 2]
        assert out.shape == demos.frames.shape[:1]
        assert 0.05 < out.mean() < 0.15
        assert view.region.any()
        return {"recorded": Clone(0.01, 0.25), "written": Clone(0.02, None)}

    monkeypatch.setattr(run, "compared", compared)
    words = [str(masked / "demos.npz"), "--exploration", str(masked / "more.npz"), "--clone"]
    assert command.main([*words, "--out", str(tmp_path), *SMALL]) == 0
    found = json.loads((tmp_path / "results.json").read_text())
    assert found["clones"]["recorded"] == {"error": 0.01, "copycat": 0.25}
    page = (tmp_path / "report.html").read_text()
    assert page.index("cloned from frames") < page.index("0.250") < page.index("Before training")
