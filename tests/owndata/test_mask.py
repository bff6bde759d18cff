"""`jaxdeconf mask` on a made-up scene: two blobs that matter, and a corner that shows the past."""

import json
import zipfile
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest

import jaxdeconf as jd
from jaxdeconf.commands import mask as command
from jaxdeconf.formats import find
from jaxdeconf.formats.source import Names
from jaxdeconf.learn.disentangle import DisentangleConfig
from jaxdeconf.nets.vae import VAEConfig
from jaxdeconf.owndata import dataset, judge
from jaxdeconf.owndata.check import check, visible
from jaxdeconf.owndata.config import Masking
from jaxdeconf.report import owndata

KEY = jax.random.key(0)
CONFIG = Masking(
    demos="scene",
    size=32,
    disentangle=DisentangleConfig(
        steps=64,
        objective="H",
        beta=2.0,
        network=VAEConfig(channels=(4, 4), latents=3, linear_path=True, norm="none"),
    ),
)
SMALL = (
    *("--size", "32", "--disentangle.steps", "64", "--disentangle.chunk", "32"),
    *("--disentangle.network.channels", "4", "4", "--disentangle.network.norm", "none"),
    *("--disentangle.network.latents", "3", "--disentangle.start-components", "3"),
)


def drawn(states, mark, random):
    """uint8 [n, 32, 32, 3]: two blobs as bright as states [n, 2], a corner for mark [n]; noise."""
    image = np.full((len(states), 32, 32, 3), 128.0)
    image[:, 4:12, 14:24] += 90 * states[:, 0, None, None, None]
    image[:, 18:26, 4:16] += 90 * states[:, 1, None, None, None]
    image[:, 22:30, 22:30] += 110 * mark[:, None, None, None]
    return np.round(image + random.normal(0, 4, image.shape)).clip(0, 255).astype(np.uint8)


def scene(episodes, steps, expert, seed, mark=None):
    """The arrays of a dataset; each episode's length differs by one from the next one's.

    Args:
      episodes, steps: how many, and of the longest.
      expert: whether actions follow from the states; else they are random.
      seed: of all of it.
      mark: what first frames show in the corner; None: anything.
    """
    random = np.random.default_rng(seed)
    initial = random.uniform(-1, 1, (episodes, 2))
    frames, actions, lengths = [], [], []
    for episode, state in enumerate(initial):
        length = steps - episode % 2
        states = state * np.linspace(1.0, 0.6, length)[:, None]
        if expert:
            acts = 0.5 * (states[:, 0] - states[:, 1]) + random.normal(0, 0.05, length)
        else:
            states = random.uniform(-1, 1, (length, 2))
            acts = random.uniform(-1, 1, length)
        first = random.uniform(-1, 1) if mark is None else mark
        frames.append(drawn(states, np.clip([first, *acts[:-1]], -1, 1), random))
        actions.append(np.clip(acts, -1, 1))
        lengths.append(length)
    return {
        "frames": np.concatenate(frames),
        "actions": 7 * np.concatenate(actions).astype(np.float32)[:, None],
        "episode_lengths": np.array(lengths),
        "initial_states": initial.astype(np.float32),
        "state_names": np.array(["left", "right"]),
        "action_limit": np.array([7.0], np.float32),
        "note": np.array("kept as it is"),
    }


def opened(arrays, path):
    """A dataset of arrays at a path, read."""
    np.savez_compressed(path, **arrays)
    return dataset.read(path, find(path, None, Names()), 32)


@pytest.fixture(scope="module")
def demos(tmp_path_factory):
    return opened(scene(400, 4, True, 0), tmp_path_factory.mktemp("data") / "demos.npz")


@pytest.fixture(scope="module")
def random_frames():
    return scene(150, 6, False, 1)["frames"]


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


def test_the_wrapper_of_the_docs_runs(masked):
    """The page's own lines, around an environment that shows frames of the dataset."""
    gymnasium = pytest.importorskip("gymnasium")
    frames = arrays_of(masked / "demos.npz")["frames"]
    page = Path(__file__).parents[2].joinpath("docs/own-data.md").read_text(encoding="utf-8")
    (block,) = [part for part in page.split("```") if part.startswith("python\nimport gymnasium")]
    told = {}
    exec(block.removeprefix("python"), told)

    class Camera(gymnasium.Env):
        observation_space = gymnasium.spaces.Box(0, 255, frames.shape[1:], np.uint8)
        action_space = gymnasium.spaces.Discrete(2)

        def reset(self, **_):
            return frames[0], {}

        def step(self, _):
            return frames[1], 0.0, False, False, {}

    env, view = told["Masked"](Camera(), masked / "out"), jd.load_view(masked / "out")
    assert np.array_equal(env.reset()[0], view(frames[0]))
    assert np.array_equal(env.step(0)[0], view(frames[1]))


def test_a_damaged_view_is_named(masked, tmp_path):
    with pytest.raises(ValueError, match=r"expected a view of jaxdeconf mask, got"):
        jd.load_view(tmp_path)
    (tmp_path / "view.json").write_bytes((masked / "out/view/view.json").read_bytes())
    (tmp_path / "arrays.npz").write_bytes(b"PK\x03\x04 and no more")
    with pytest.raises(ValueError, match=r"expected a view of jaxdeconf mask, got"):
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
        (["demos.npz", "--horizon", "4"], "horizon: expected at most 3, the steps of episode 1"),
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


def test_a_mark_that_first_frames_do_not_vary_is_refused(demos, random_frames, tmp_path):
    """The silent failure: no test on first frames can find it."""
    still = opened(scene(400, 4, True, 0, mark=0.0), tmp_path / "still.npz")
    words = "first frames do not vary what component . shows"
    refused = check(still, random_frames, CONFIG, KEY)
    assert refused.refused is not None
    assert words.replace(".", refused.refused.split("component ")[1][0]) in refused.refused
    assert check(still, random_frames, replace(CONFIG, unvaried="keep"), KEY).refused is None
    assert check(demos, random_frames, CONFIG, KEY).refused is None


def test_causes_that_no_single_state_shows_are_refused(demos, random_frames):
    """An action that is the product of two states: each alone is independent of it."""
    states = np.sign(demos.initial_states[:, :1] * demos.initial_states[:, 1:])
    states = states + np.random.default_rng(2).normal(0, 0.1, states.shape)
    product = np.repeat(states, demos.lengths, axis=0).astype(np.float32)
    found = check(demos._replace(actions=product / 2), random_frames, CONFIG, KEY)
    assert found.refused is not None
    assert "left, right move the actions only together" in found.refused


def test_states_that_move_nothing_are_refused(demos, random_frames):
    noise = np.random.default_rng(3).normal(size=demos.actions.shape).astype(np.float32)
    found = check(demos._replace(actions=noise), random_frames, CONFIG, KEY)
    assert found.refused is not None
    assert "no initial state moves an action" in found.refused


def test_what_looks_wrong_is_said(demos, random_frames):
    """Constant, dependent and drifting states; actions that are shifted, at their limit, few."""
    states, count = demos.initial_states, len(demos.lengths)
    drift = np.arange(count)[:, None] + 0.0 * states[:, :1]
    wrong = np.concatenate([states, states[:, :1] ** 3, drift, 0 * drift], axis=1)
    actions = np.sign(demos.actions)
    actions[demos.first] = 0.0
    names = ["left", "right", "cubed", "drift", "still"]
    odd = demos._replace(initial_states=wrong, state_names=names, actions=actions)
    said = " ".join(check(odd, random_frames, CONFIG, KEY).notes)
    for words in (
        "not asked for: still",
        "left and cubed",
        "Drifts from episode to episode: drift",
    ):
        assert words in said
    for words in ("The first action of every episode is 0", "are at their limit", "3 values only"):
        assert words in said


def test_the_least_horizon_in_which_every_state_shows_is_taken(demos, random_frames):
    """An expert that reacts to the second state only in its third step."""
    actions = demos.actions.copy()
    for state, step in ((0, 0), (0, 1), (1, 2)):
        at = demos.first + step
        actions[at, 0] = demos.initial_states[:, state]
    assert check(demos._replace(actions=actions), random_frames, CONFIG, KEY).horizon == 3


def test_more_episodes_show_more():
    assert visible(50) == pytest.approx(0.61, abs=0.01)
    assert visible(600) == pytest.approx(0.20, abs=0.01)
    assert visible(10**6) == pytest.approx(0.064, abs=0.001)  # gamma hides what is weaker


def test_with_few_episodes_the_previous_action_must_agree():
    """What is masked because its state is not seen to move anything stays."""
    mask, share = np.array([True, True, False]), np.array([0.99, 0.01, 0.5])
    assert judge.confirmed(mask, share, 600, CONFIG).tolist() == [True, True, False]
    assert judge.confirmed(mask, share, 150, CONFIG).tolist() == [True, False, False]
    always = replace(CONFIG, min_power=0.9)
    assert judge.confirmed(mask, share, 150, always).tolist() == [True, True, False]


@pytest.mark.parametrize("shape", [(32, 32), (48, 64), (20, 50), (96, 96)])
def test_frames_come_to_size_by_area_and_back_in_their_shape(shape):
    """Reference: the mean of what a pixel covers, where sides divide."""
    image = np.random.default_rng(4).integers(0, 256, (2, *shape, 3), dtype=np.uint8)
    small = dataset.fitted(image, 32)
    assert small.shape == (2, 32, 32, 3)
    top, left, height, width = dataset.inner(shape, 32)
    assert height / width == pytest.approx(shape[0] / shape[1], rel=0.1)
    assert not small[:, :top].any()
    assert not small[:, :, :left].any()
    if shape == (96, 96):
        mean = image.reshape(2, 32, 3, 32, 3, 3).mean(axis=(2, 4))
        assert np.abs(small - mean).max() < 1.0  # twice rounded
    assert dataset.unfitted(small, shape).shape == image.shape


def test_the_words_of_a_kept_latent_name_the_number_of_episodes(masked):
    from jaxdeconf.owndata.results import Found
    from jaxdeconf.pipeline import results

    found, _ = results.load(masked / "out", Found)
    asked = np.ones_like(found.mask)
    said = " ".join(owndata.verdict(found._replace(asked=asked)))
    assert "Algorithm 1 would have masked" in said
    assert "400 episodes show only correlations" in said
    assert owndata.summary(found, Path("out")).endswith("report: out/report.html")
