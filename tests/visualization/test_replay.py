"""Replays: recordings of rollouts, and what the page shows of them in a real browser."""

from __future__ import annotations

import dataclasses
import gzip
import importlib
import re
import sys
from pathlib import Path

import numpy as np
import pytest

from modgnn_rl.configs.schema import FlockingConfig, ReplayConfig
from modgnn_rl.envs.flocking.task import FlockingTask
from modgnn_rl.errors import InputError
from modgnn_rl.evaluation.recording import Recorder, record
from modgnn_rl.evaluation.rollout import rollout
from modgnn_rl.nn.topology import as_matrix
from modgnn_rl.replay import check_request
from modgnn_rl.visualization import html
from modgnn_rl.visualization.recording import QUANTUM, MetricSeries, Recording, recording_stride

sys.path.insert(0, str(Path(__file__).parents[1]))
browser = importlib.import_module("browser")

needs_chromium = pytest.mark.skipif(
    browser.CHROMIUM is None, reason="no chromium on this machine: nothing to open a page with"
)
PERTURBED = FlockingConfig(num_agents=7, message_loss=0.3, delay=1, range_spread=0.3, dropout_rate=2.0)


def _record(env_config, agents=7, steps=30, stride=1, name="expert"):
    """A recording, and for each step the edges of the graph and the positions."""
    recorder, seen = Recorder(FlockingTask(env_config), stride), []

    def watch(flocks):
        recorder(flocks)
        edges = as_matrix(flocks["adjacency"], agents)[0].nonzero()
        seen.append((edges.numpy(), flocks[env_config.state_key][0, :, :3].double().numpy()))

    policy = FlockingTask(env_config).reference_policies()[name]
    rollout(policy, FlockingTask(env_config), num_agents=agents, num_flocks=2, steps=steps, seed=5, watch=watch)
    return recorder.recording(), seen


@pytest.mark.parametrize("graph", ["matrix", "links"])
def test_recorded_edges_are_those_of_the_perturbed_graph(graph):
    recording, seen = _record(dataclasses.replace(PERTURBED, graph=graph))
    assert any(len(flips) for flips in recording.flips)
    assert not recording.present.all()
    for step, (edges, position) in enumerate(seen):
        assert np.array_equal(recording.frame(step).edges, edges)
        assert np.abs(recording.position[step] * QUANTUM - position).max() <= QUANTUM / 2


def test_a_stride_records_every_nth_step():
    (all_steps, _), (some, _) = (_record(PERTURBED, stride=stride) for stride in (1, 4))
    assert np.array_equal(some.position, all_steps.position[::4])
    assert np.array_equal(some.metrics["error"].values, all_steps.metrics["error"].values[::4])
    cases = ((32, 1000), (1000, 1000), (32, 1000, 250), (2, 10, 250))
    assert [recording_stride(*case) for case in cases] == [1, 5, 4, 1]


def _unpack(data, agents, steps, num_metrics):
    """Decode what `html.pack` encoded, following its docstring."""
    raw, place = gzip.decompress(data), 0

    def planes(count, integrations):
        nonlocal place
        size = 3 * agents * steps
        codes = np.zeros(size, np.uint64)
        for plane in range(count):
            codes |= np.frombuffer(raw, np.uint8, size, place).astype(np.uint64) << np.uint64(8 * plane)
            place += size
        values = (codes >> np.uint64(1)).astype(np.int64) ^ -(codes & np.uint64(1)).astype(np.int64)
        values = values.reshape(3, agents, steps)
        for _ in range(integrations):
            values = values.cumsum(-1)
        return values.transpose(2, 1, 0)

    position, velocity = planes(4, 2), planes(2, 1)
    present = np.frombuffer(raw, np.uint8, agents * steps, place).reshape(agents, steps).T.astype(bool)
    place += agents * steps
    metrics = np.frombuffer(raw, "<f4", num_metrics * steps, place).reshape(-1, steps)
    place += 4 * metrics.size
    numbers, value, shift = [], 0, 0
    for byte in raw[place:]:
        value |= (byte & 127) << shift
        shift += 7
        if byte < 128:
            numbers.append(value)
            value = shift = 0
    flips, numbers = [], iter(numbers)
    for _ in range(steps):
        flips.append(np.cumsum([next(numbers) for _ in range(next(numbers))], dtype=np.int64))
    assert next(numbers, None) is None
    return position, velocity, present, metrics, flips


@pytest.mark.parametrize("agents", [1, 200])
def test_packing_is_lossless(agents):
    random, steps, pairs = np.random.default_rng(0), 9, agents**2
    recording = Recording(
        position=random.integers(-(2**28), 2**28, (steps, agents, 3), dtype=np.int32),
        arrow=random.uniform(-0.5, 0.5, (steps, agents, 3)).astype(np.float32),
        present=random.random((steps, agents)) < 0.5,
        flips=[np.sort(random.choice(pairs, int(random.integers(0, pairs)), replace=False)) for _ in range(steps)],
        metrics={name: MetricSeries(name, "m", random.random(steps)) for name in ("error", "cohesion")},
        stride=1,
        comm_range=3.5,
        max_arrow=0.92,
        frequency=48.0,
    )
    position, velocity, present, metrics, flips = _unpack(html.pack(recording), agents, steps, 2)
    assert np.array_equal(position, recording.position)
    assert np.abs(velocity * 0.92 / html.ARROW_STEPS - recording.arrow).max() < 0.0037
    assert np.array_equal(present, recording.present)
    assert np.array_equal(metrics, np.stack([series.values for series in recording.metrics.values()]).astype("f4"))
    assert all(np.array_equal(one, other) for one, other in zip(flips, recording.flips, strict=True))


def _page(tmp_path, env_config=PERTURBED, names=("expert", "zero action"), title="a </script> title", **rollout):
    recordings = {name: _record(env_config, name=name, **rollout)[0] for name in names}
    path = tmp_path / "replay.html"
    html.write_replay(path, recordings, title, {"seed": 5})
    return path


def test_the_page_loads_nothing_and_escapes_names(tmp_path):
    text = _page(tmp_path, steps=4).read_text(encoding="utf-8")
    assert "default-src 'none'" in text
    assert not re.search(r"https?://|@import|\bfetch\(|XMLHttpRequest|WebSocket|<link(?![^>]*data:)|\bsrc=", text)
    assert "a &lt;/script&gt; title" in text
    assert "{{" not in text


@pytest.mark.slow
def test_two_rollouts_of_32_agents_and_1000_steps_take_less_than_a_megabyte(tmp_path):
    env_config, names = FlockingConfig(), ("expert", "local expert (1 hop)")
    policies = FlockingTask(env_config).reference_policies()
    rollouts = {
        name: record(policies[name], FlockingTask(env_config), num_agents=32, steps=1000, seed=5) for name in names
    }
    html.write_replay(tmp_path / "replay.html", rollouts, "two rollouts")
    assert (tmp_path / "replay.html").stat().st_size < 1_000_000


def test_invalid_settings_are_one_sentence(tmp_path):
    (tmp_path / "config.yaml").write_text("schema_version: 2\n")
    run = str(tmp_path)
    for config, words in (
        (ReplayConfig(run=str(tmp_path / "none")), "none"),
        (ReplayConfig(run=run, output=str(tmp_path / "no" / "a.html")), "folder that does not exist"),
        (ReplayConfig(run=run, output=str(tmp_path)), r"a file whose name ends in \.html"),
        (ReplayConfig(run=run, format="svg", output="a.png"), r"a file whose name ends in \.svg"),
        (ReplayConfig(run=run, step=5), "step=5 is the step of an image"),
        (ReplayConfig(run=run, format="svg", step=1000), "step=1000 is beyond the rollout"),
        (ReplayConfig(run=run, format="mp4", viewer=True), "a video shows one policy"),
    ):
        with pytest.raises(InputError, match=words) as error:
            check_request(config)
        assert "\n" not in str(error.value)


def test_equal_recordings_give_equal_images(tmp_path):
    pytest.importorskip("matplotlib")
    from modgnn_rl.visualization.image import write_image

    recording, _ = _record(PERTURBED, steps=4)
    for name in ("a.svg", "b.svg"):
        write_image(tmp_path / name, {"expert": recording}, 3)
    assert (tmp_path / "a.svg").read_bytes() == (tmp_path / "b.svg").read_bytes()
    assert b"expert" in (tmp_path / "a.svg").read_bytes()


# ---- in a browser

IMAGE = "(() => { const c = panes[0].canvas; return c.toDataURL(); })()"
COLOURS = """(() => {
  const c = panes[0].canvas, d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data, s = new Set();
  for (let i = 0; i < d.length; i += 4) s.add(d[i] << 16 | d[i + 1] << 8 | d[i + 2]);
  return s.size;
})()"""
SHOWN = "JSON.stringify([state, document.documentElement.dataset.theme], (name, value) => name === 'drawn' ? 0 : value)"


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    return _page(tmp_path_factory.mktemp("page"), steps=60)


def _open(window, page):
    window.open(page.as_uri())
    window.wait("!document.getElementById('app').hidden")
    window.wait("state.drawn > 1")


def _changes(window, act, what):
    """An action changes what is shown, and the page still draws a frame later."""
    before, drawn = window.run(SHOWN), window.run("state.drawn")
    act()
    window.wait(f"{SHOWN} !== {before!r}")
    window.wait(f"state.drawn > {drawn}")
    assert window.run(SHOWN) != before, what


def _quiet(window):
    """No error, nothing on the console, and only the page itself was asked for."""
    bad = {"Runtime.consoleAPICalled", "Runtime.exceptionThrown", "Log.entryAdded"}
    assert [event for event in window.events if event["method"] in bad] == []
    asked = [e["params"]["request"]["url"] for e in window.events if e["method"] == "Network.requestWillBeSent"]
    assert len([url for url in asked if not url.startswith("data:")]) == 1, asked


@pytest.mark.slow
@needs_chromium
@pytest.mark.parametrize("dark", [False, True])
def test_the_page_plays_and_holds_what_was_recorded(page, dark):
    with browser.Browser(dark=dark) as window:
        _open(window, page)
        assert window.run("document.documentElement.dataset.theme") == ("dark" if dark else "light")
        window.run("goTo(0)")
        clock = window.run("document.getElementById('clock').textContent")
        window.run("play(true)")
        window.wait(f"document.getElementById('clock').textContent !== {clock!r}")
        window.wait("!state.playing")  # at its end it stops
        assert "step 59 / 59" in window.run("document.getElementById('clock').textContent")
        assert window.run(COLOURS) > 50
        recording, seen = _record(PERTURBED, steps=60)
        for step in (0, 17, 59):
            window.run(f"goTo({step} * PERIOD)")
            assert window.run("frameNow()") == step
            assert window.run(f"findEdges(rollouts[0], {step}).directed") == len(seen[step][0])
            at = window.run(f"Array.from({{length: N}}, (_, n) => rollouts[0].position[n * T + {step}])")
            assert at == recording.position[step, :, 0].tolist()
        _quiet(window)


@pytest.mark.slow
@needs_chromium
def test_every_control_acts_by_mouse_and_keyboard(page):
    with browser.Browser() as window:
        _open(window, page)
        window.run("play(false); goTo(0.5)")
        for name in window.run("Object.keys(ACTIONS)"):
            if name == "reset":
                window.run("turn(1, 0)")
            _changes(window, lambda name=name: window.click(f"#{name}"), name)
            window.run("play(false); goTo(0.5); document.activeElement.blur()")
        for key in [*window.run("Object.keys(KEYS)"), "ArrowLeft", "ArrowRight", "Home", "End", "[", "]"]:
            window.run("play(false); goTo(0.5)")
            if key == "0":
                window.run("turn(1, 0)")
            if key in ("b", "f"):
                window.run("window.scrollTo(0, 0)")
            _changes(window, lambda key=key: window.key(key), key)
        window.run("play(false); goTo(0.5); setSpeed(1); if (!state.both) toggle('both')")
        _changes(window, lambda: window.click("#scrub", 0.9), "scrub")
        _changes(window, lambda: window.click("#charts canvas", 0.3), "chart")
        _changes(window, lambda: window.drag("#panes canvas", (60, 20)), "drag")
        _changes(window, lambda: window.run("byId('speed').value = 4; byId('speed').dispatchEvent(new Event('change'))"
                                            "; goTo(0.3)"), "speed")  # fmt: skip
        before = window.run(IMAGE)
        window.run("panes[0].select.value = 1; panes[0].select.dispatchEvent(new Event('change'))")
        window.wait(f"{IMAGE} !== {before!r}")
        window.key("?")
        assert window.run("byId('help').open")
        _quiet(window)


@pytest.mark.slow
@needs_chromium
def test_a_phone_shows_all_of_it_and_every_control_acts_by_touch(page):
    with browser.Browser(390, 844, phone=True) as window:
        _open(window, page)
        assert window.run("document.documentElement.scrollWidth") <= 390
        window.run("play(false); goTo(0.5)")
        box = "const b = byId(n).getBoundingClientRect();"
        small = f"Object.keys(ACTIONS).filter((n) => {{ {box} return b.width < 36 || b.height < 36; }})"
        assert window.run(small) == []
        for name in window.run("Object.keys(ACTIONS)"):
            if name == "reset":
                window.run("turn(1, 0)")
            _changes(window, lambda name=name: window.tap(f"#{name}"), name)
            window.run("play(false); goTo(0.5)")
        window.run("if (!state.both) toggle('both')")
        x, y = window.place("#panes canvas")
        _changes(window, lambda: window.touch(((x, y), (x + 50, y + 20))), "one finger")
        zoom = window.run("state.zoom")
        window.touch(((x - 20, y), (x - 60, y)), ((x + 20, y), (x + 60, y)))
        window.wait(f"state.zoom > {1.5 * zoom}")
        _quiet(window)


@pytest.mark.slow
@needs_chromium
def test_a_thousand_agents_are_shown(tmp_path):
    env_config = FlockingConfig(num_agents=1000, start_radius=12.0, graph="links", comm_range=2.0)
    page = _page(tmp_path, env_config, ("expert",), agents=1000, steps=4)
    with browser.Browser() as window:
        _open(window, page)
        window.run("goTo(PERIOD)")
        assert window.run(COLOURS) > 50
        _quiet(window)
