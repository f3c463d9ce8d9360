"""The page that plays saved rollouts: it holds the right numbers, loads nothing, and works in a browser."""

from __future__ import annotations

import base64
import dataclasses
import html
import json
import math
import re
import shutil
import subprocess
import sys
import zlib
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from helpers_saved import played, random_trees, searched
from helpers_segments import crossing, hide, random_segment, straight_road
from symphony.cli import main
from symphony.cli.rollouts import places
from symphony.errors import DataError
from symphony.evaluation.report import Report, add_segment
from symphony.render.viewer import Event, Replay, packed, view_page
from symphony.render.viewer.pack import packed_log
from symphony.saved.folder import About, load_rollouts, save_rollouts
from symphony.saved.rollouts import SavedRollouts

ABOUT = About("made </script><b>\udce9")


def blocks(page: str) -> list[str]:
    """The logs of the segments in a page."""
    return re.findall(r'<script type="text/plain" id="segment-\d+">([^<]*)</script>', page)


def unpacked(text: str) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Facts and arrays of a packed segment, as the page reads them."""
    block = zlib.decompress(base64.b64decode(text, validate=True))
    length = int.from_bytes(block[:4], "little")
    header = json.loads(block[4 : 4 + length])
    types = {"i32": np.int32, "i16": np.int16, "u8": np.uint8, "f32": np.float32}
    found = {}
    for item in header["arrays"]:
        at = (math.prod(item["shape"]), 4 + length + item["offset"])
        raw = np.frombuffer(block, types[item["type"]], *at).reshape(item["shape"])
        raw = raw.cumsum(-1) if item.get("delta") else raw
        found[item["name"]] = raw * item.get("scale", 1)
    return header["facts"], found


def pages() -> list[SavedRollouts]:
    tracks = hide(crossing(5, steps=21), 3, slice(4, 9))
    turned = tracks.replace(heading=tracks.heading + np.float32(4 * np.pi))
    saved = played(turned, [0, 2], 3, failed={2: "broke <b>off</b>\udce9"})
    plan = np.random.default_rng(0).normal(0, 30, (3, 2, saved.steps, 4, 2)).astype("f4")
    plan[1, :, 3:, 2:], plan[2] = np.nan, np.nan
    saved = dataclasses.replace(saved, trees=random_trees(saved, branches=5), plan=plan)
    lost = random_segment("odd name", seed=3, agents=4, steps=6, lights=2, marks=3)
    return [saved, played(straight_road(2, steps=16)), played(lost, [1])]


@pytest.mark.parametrize("number", range(3))
def test_a_packed_segment_holds_its_numbers(number: int) -> None:
    saved = pages()[number]
    event = Event(0, 3, 0, "collision", "into leader", 1, True, "collision")
    steps = np.random.default_rng(number).uniform(0, 20, saved.counted.shape)
    facts, arrays = unpacked(packed(Replay(saved, [event], steps)))
    known, held = unpacked(packed_log(saved))
    facts, arrays = facts | known, arrays | held
    segment, there = saved.segment, np.concatenate([saved.counted[:, :1], saved.counted], 1)
    expected = {
        "id": segment.segment_id, "rollouts": saved.rollouts, "steps": saved.steps, "dt": segment.dt,
        "ids": [str(i) for i in segment.agent_id], "events": [dataclasses.asdict(event)],
    }  # fmt: skip
    assert facts.items() >= expected.items()
    exact = {"log.valid": segment.valid, "lights.state": segment.signal_state, "goal": saved.goal}
    exact["sim.valid"] = there.swapaxes(1, 2)
    np.testing.assert_allclose(arrays["ttc"], np.minimum(steps, 10.2).swapaxes(1, 2), atol=0.021)
    if saved.plan is not None:
        shown = np.isfinite(saved.plan).all(-1)
        exact["plan.count"] = shown.sum(-1)
        for axis, letter in enumerate("xy"):
            np.testing.assert_allclose(arrays[f"plan.{letter}"][shown], saved.plan[shown, axis], atol=0.006)
    near, state = {}, np.where(there[..., None], saved.state, 0).swapaxes(1, 2)
    for axis, letter in enumerate("xy"):
        near |= {f"sim.{letter}": state[..., axis], f"log.{letter}": segment.position[..., axis]}
        for name in ("lanes", "boundary", "marks"):
            near[f"{name}.{letter}"] = getattr(segment.road, name).points[:, axis]
            exact[f"{name}.offsets"] = getattr(segment.road, name).offsets
    np.testing.assert_allclose(np.cos(state[..., 2] - arrays["sim.h"]), 1, atol=1e-7)
    np.testing.assert_allclose(arrays["size"], segment.size[:, :2], atol=0.006)
    if saved.trees is not None:
        arrays["tree.x"] = arrays["tree.x"].swapaxes(2, 3)
        near["tree.x"] = np.where(saved.trees.there, saved.trees.state[..., 0], 0)
        exact["tree.valid"] = saved.trees.there.swapaxes(2, 3)
        exact |= {"tree.totals": saved.trees.totals, "tree.parents": saved.trees.parents}
    for name, value in near.items():
        np.testing.assert_allclose(arrays[name], value, rtol=0, atol=6e-4, err_msg=name)
    for name, value in exact.items():
        np.testing.assert_array_equal(arrays[name], value, err_msg=name)


def test_numbers_too_large_for_a_page_and_others_of_another_log_are_refused() -> None:
    one, longer, wild = (played(straight_road(2, steps=steps)) for steps in (16, 21, 16))
    wild.state[0, 2, 0, 3] = 400.0
    for shown, why in (
        ([wild], r", field sim\.s: numbers beyond"),
        ([one, longer], ": two was simulated on another log, or for other"),
    ):
        with pytest.raises(DataError, match="segment straight-0" + why):
            view_page(["one", "two"][: len(shown)], [list(map(Replay, shown))])


def test_the_page_holds_all_segments_and_loads_nothing(tmp_path: Path) -> None:
    found = pages()
    save_rollouts(tmp_path / "sim", ABOUT, found)
    assert main(["view", str(tmp_path / "sim")]) == 0
    page = (tmp_path / "sim" / "view.html").read_text(encoding="utf-8")
    assert [unpacked(block)[0]["id"] for block in blocks(page)] == [s.segment.segment_id for s in found]
    about = re.search(r'<script type="application/json" id="about">(.*?)</script>', page)
    assert json.loads(about[1])["names"] == [ABOUT.agent]
    # Of several folders the ends of their paths tell them apart.
    shutil.copytree(tmp_path / "sim", tmp_path / "b" / "sim")
    folders = [load_rollouts(tmp_path / name) for name in ("sim", "b/sim", "b/../sim")]
    assert places(folders) == [f"{where}/sim: " for where in (tmp_path.name, "b", tmp_path.name)]
    assert "http" not in re.sub(r'id="segment-\d+">[^<]*', "", page)
    assert not re.search(r"\b(src|href)\s*=|@import|url\(|fetch\(|XMLHttpRequest|import\(", page)
    assert "/*" not in re.sub(r"/\*.*?\*/", "", page, flags=re.S)


def test_what_panes_share_of_a_log_is_all_of_it() -> None:
    """Who is driven in one folder may play the log back in another, past its end as well."""
    segment = straight_road(3, steps=16).replace(logged=11)
    for agents in ([0], [1, 2]):
        held = unpacked(packed_log(played(segment, agents)))[1]["log.valid"]
        np.testing.assert_array_equal(held, segment.valid)


def test_chosen_segments_pictures_and_animations(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    save_rollouts(tmp_path / "sim", ABOUT, pages()[:2])
    sim, page = str(tmp_path / "sim"), tmp_path / "one.html"
    assert main(["view", sim, "--segments", "straight-0", "--out", str(page)]) == 0
    assert [unpacked(block)[0]["id"] for block in blocks(page.read_text())] == ["straight-0"]
    for name in ("a.png", "a.gif"):
        assert main(["view", sim, "--out", str(tmp_path / name)]) == 0
        with Image.open(tmp_path / name) as image:
            assert getattr(image, "n_frames", 1) == (1 if name == "a.png" else 21)
    wrong = {("--out", str(tmp_path / "a.doc")): ".mp4", ("--segments", "nothing"): "no rollouts of this segment"}
    save_rollouts(tmp_path / "other", ABOUT, pages()[2:3])
    wrong |= {("--rollouts", "1"): "a page plays all", (str(tmp_path / "other"), "--out", "b.png"): "in every folder"}
    wrong[str(tmp_path / "other"), "--segments", "straight-0", "--out", "b.png"] = "no rollouts of this segment"
    for words, why in wrong.items():
        assert main(["view", sim, *words]) == 1
        assert why in capsys.readouterr().err


def test_a_film_needs_its_encoder(tmp_path: Path, capsys: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    save_rollouts(tmp_path / "sim", ABOUT, [played(straight_road(2, steps=6))])
    film = tmp_path / "a.mp4"
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "imageio_ffmpeg", None)
        assert main(["view", str(tmp_path / "sim"), "--out", str(film)]) == 1
        assert "symphony-traffic[video]" in capsys.readouterr().err
        assert not film.exists()
    pytest.importorskip("imageio_ffmpeg", reason="needs the extra 'video'")
    assert main(["view", str(tmp_path / "sim"), "--out", str(film)]) == 0
    assert film.read_bytes()[4:8] == b"ftyp"


@lru_cache
def chromium() -> str:
    found = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if found is None:
        pytest.skip("no Chromium is installed")
    return found


def browse(page: Path, *options: str, place: str = "") -> str:
    """Return what a browser without a network makes of a page."""
    fixed = ["--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--window-size=1200,800"]
    alone = ["--host-resolver-rules=MAP * ~NOTFOUND", f"--user-data-dir={page.parent / 'profile'}"]
    command = [chromium(), *fixed, *alone, *options, page.as_uri() + place]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=120).stdout


def driven_page(tmp_path: Path, script: str, found: list[SavedRollouts], planners: int = 1) -> dict[str, Any]:
    """Return what a script put into `out` once the page was ready; planners in turn are of one segment."""
    names = [f"made <i> {number}" for number in range(planners)]
    shown = []
    for saved in found:
        add_segment(report := Report("made", "interactive"), saved)
        shown.append(report.replay(saved))
    page = view_page(names, [shown[k : k + planners] for k in range(0, len(shown), planners)])
    test = """<script>(async () => {
      const wait = () => new Promise(done => setTimeout(done, 50));
      while (!document.body.dataset.ready) await wait();
      const out = {};
      try { %s } catch (error) { out.error = String(error.stack); }
      document.body.dataset.out = JSON.stringify(out);
    })();</script>"""
    file = tmp_path / "page.html"
    file.write_text(page.replace("</body>", test % script + "</body>"), encoding="utf-8")
    dom = browse(file, "--virtual-time-budget=8000", "--dump-dom")
    (told,) = re.findall(r'data-out="([^"]*)"', dom) or pytest.fail(dom[-3000:])
    out = json.loads(html.unescape(told))
    assert "error" not in out, out
    return out


def crash() -> SavedRollouts:
    """Agent 0 runs into agent 1 after 2 s in rollout 1."""
    segment = straight_road(2, steps=31, num_lanes=1)
    saved = played(segment, [0], 2)
    ahead = segment.position[1, :, 0] - 4
    saved.state[1, 10:, 0, 0] = ahead[10:]
    saved.state[1, :10, 0, 0] = np.linspace(saved.state[1, 0, 0, 0], ahead[9] - 2, 10)
    return saved


@pytest.mark.slow
def test_the_browser_reads_the_numbers_and_reacts(tmp_path: Path) -> None:
    saved = crash()
    _, (tree, *_) = searched()
    script = """
      const r = scene.replay, n = 0;
      out.segments = Array.from($("segment").options, o => o.textContent);
      out.notes = Array.from($("rollout").options, o => o.textContent);
      out.x = Array.from(r["sim.x"]); out.h = Array.from(r["sim.h"]);
      choose(1); out.events = $("events").textContent;
      document.querySelector("#events li").click(); frame(0);
      out.jumped = view.t; out.agent = view.agent; out.who = $("who").textContent; out.hash = location.hash;
      seek(4.5); out.between = r.simulated(0, 0, 4.5).x;
      const before = camera.scale; zoomBy(2); out.zoomed = camera.scale / before;
      play(true); for (let i = 0; i < 6; i++) { frame(1000 + 100 * i); } out.played = view.t; play(false);
      view.follow = 0; dirty = true; frame(0); out.followed = [camera.x, r.simulated(1, 0, view.t).x];
      const there = r.logged(1, view.t), at = camera.toScreen(there.x, there.y);
      out.picked = scene.pick(view, ...camera.toWorld(...at));
      const maps = scene.map.drawn;
      for (let i = 0; i < 20; i++) { seek(i / 2); frame(0); }
      out.redrawn = scene.map.drawn - maps;
      await open(1); out.periods = search.periods; out.place = location.hash;
      const two = scene.replay, driven = Array.from(two.agents);
      two.drivers = driven.map((_, n) => n ? "background:idm" : "");
      out.roles = driven.map(row => role(two, row)); out.names = driven.map(row => followName(two, row));
      out.fates = Array.from({length: search.branches}, (_, s) => search.fate(0, 0, s)[0]);
      out.history = search.history(0, search.periods - 1, search.slot(0, search.periods - 1, 0));
      const box = $("tree").getBoundingClientRect(), l = search.layout();
      const where = { clientX: box.left + l.left + 2, clientY: box.top + l.top + 2, bubbles: true };
      $("tree").dispatchEvent(new MouseEvent("click", where));
      out.branch = $("branch").textContent;
      let points = 0;
      const pen = new Proxy({}, { get: () => () => { points++; }, set: () => true });
      const drawn = () => { points = 0; scene.branch(pen, view); return points; };
      seek(view.branch.steps.length);
      out.drawn = drawn();
      two["tree.valid"].fill(0); out.absent = drawn(); out.peak = search.peak(0, 0, 0);
      search.total = () => 0; out.tied = out.fates.every((_, s) => search.fate(0, 0, s)[1].includes("the best"));
    """
    out = driven_page(tmp_path, script, [saved, tree])
    assert out["segments"] == [saved.segment.segment_id, tree.segment.segment_id]
    assert out["notes"] == ["0", "1 · collision, at fault"]
    assert (out["jumped"], out["agent"], out["picked"], out["peak"], out["tied"]) == (10, 0, 1, None, True)
    np.testing.assert_allclose(out["x"], saved.state[..., 0, 0].ravel(), atol=6e-4)
    np.testing.assert_allclose(out["h"], saved.state[..., 0, 2].ravel(), atol=6e-5)
    told = {"2.0 s": "events", "into leader at fault": "events", "vehicle": "who", "rollout=1": "hash"}
    assert all(text in out[where] for text, where in told.items())
    assert out["between"] == pytest.approx(saved.state[0, 4:6, 0, 0].mean(), abs=1e-3)
    assert (out["zoomed"], out["played"]) == pytest.approx((2, 4.5 + 2.5))  # half a second at 5 Hz
    assert out["followed"][0] == pytest.approx(out["followed"][1])
    assert out["redrawn"] <= 6
    trees: Any = tree.trees
    assert out["periods"] == trees.parents.shape[1]
    slots = np.arange(trees.parents.shape[-1])
    kept, went_on = (np.isin(slots, of) for of in (trees.slots[0, 0], trees.parents[0, 0]))
    assert out["fates"] == np.where(kept, "kept", np.where(went_on, "died out", "pruned")).tolist()
    assert out["history"] == trees.slots[0, np.arange(tree.steps) // trees.prune_every, 0].tolist()
    assert "t=0.00" in out["place"]  # not the time at which the segment before was left
    assert out["roles"] == ["ego", "background, driven by idm"]
    assert [name.split()[0] for name in out["names"]] == ["ego", "background"]
    assert out["branch"].startswith("Branch 0, 0.0–")
    # Of agents that are not there, nothing is drawn.
    agents = len(tree.agents)
    assert out["drawn"] > 5 * agents > out["absent"] == 3 * agents  # an empty path each, stroked twice
    highest = trees.score[0, 0, : trees.prune_every].max()
    assert f"Highest score: {highest:.2f}, agent " in out["branch"]


@pytest.mark.slow
def test_a_link_follows_the_ego_and_the_legend_says_what_is_what(tmp_path: Path) -> None:
    segment = crossing(num_agents=12).replace(ego=3, segment_id="crossing")
    saved = played(segment, range(12), routes=segment.road.lanes, goal=np.zeros((1, 12), np.int64))
    script = """
      location.hash = "#segment=crossing&rollout=0&t=1.4&follow=ego";
      await fromPlace(); frame(0);
      const r = scene.replay, there = r.state(0, r.ego, view.t);
      out.follow = view.follow; out.agent = view.agent; out.t = view.t; out.hash = location.hash;
      out.camera = [camera.x - there.x, camera.y - there.y];
      out.colors = Array.from(r.agents, row => r.color(row)); out.legend = $("legend").textContent;
      const strokes = [];
      const noted = (_, name, value) => { if (name === "strokeStyle") strokes.push(value); return true; };
      const pen = new Proxy({}, { get: () => () => {}, set: noted });
      for (const row of [r.ego, 0]) scene.box(pen, row, there, "red", 1);
      out.strokes = strokes;
      select(0); out.other = view.follow;
      r.events.push({ kind: "blocking" }); legend(r); out.blocks = $("legend").textContent;
    """
    out = driven_page(tmp_path, script, [saved])
    assert (out["follow"], out["agent"], out["t"]) == (3, 3, pytest.approx(1.4 / segment.dt))
    assert f"follow={segment.agent_id[3]}" in out["hash"]
    np.testing.assert_allclose(out["camera"], 0, atol=1e-9)
    assert (out["colors"].count(out["colors"][3]), len(set(out["colors"]))) == (1, 8)
    assert (out["strokes"], out["other"]) == (["#2b2f36", "white"], 0)
    assert all(text in out["legend"] for text in ("light: stop", "light: go", "goal", "playback", "log"))
    assert not any(text in out["legend"] for text in ("stop sign", "blocks"))
    assert out["blocks"].replace("△blocks traffic", "") == out["legend"]


@pytest.mark.slow
def test_planners_play_side_by_side_and_rollouts_are_chosen_by_events(tmp_path: Path) -> None:
    hits, calm = crash(), played(straight_road(2, steps=31, num_lanes=1), [0, 1], 2, failed={0: "lost"})
    hits.state[1, :10, 0, 3] += 5
    plan = np.full((2, 2, calm.steps, 3, 2), np.nan, np.float32)
    plan[1, 0, 4, :2], plan[1, 1, 5, 0] = [(40, 1), (50, 2)], (7, 8)
    calm = dataclasses.replace(calm, plan=plan)
    other, same = (played(straight_road(3, 11, segment_id="other", num_lanes=1)) for _ in range(2))
    script = """
      const texts = (id, of) => Array.from($(id).options, o => o[of]);
      out.names = panes.map(pane => pane.box.textContent.trim());
      out.kinds = about.segments.map(one => one.kinds); out.filters = texts("filter", "value");
      const seen = () => [texts("segment", "textContent"), texts("rollout", "value"), view.segment, view.rollout];
      const filter = async kind => {
        $("filter").value = kind; $("filter").dispatchEvent(new Event("change"));
        await new Promise(done => setTimeout(done, 200));
        return seen();
      };
      out.all = seen(); out.fault = await filter("fault"); out.failed = await filter("failed"); await filter("");
      choose(1); seek(12); frame(0);
      const [one, two] = panes.map(pane => pane.scene.replay);
      out.x = [one, two].map(r => r.simulated(1, 0, 12).x);
      out.drawn = panes.map(({ context, canvas }) => {
        const { data } = context.getImageData(0, 0, canvas.width, canvas.height);
        let blue = 0;
        for (let i = 0; i < data.length; i += 4) blue += !data[i] && data[i + 1] === 0x72 && data[i + 2] === 0xb2;
        return blue;
      });
      out.wide = panes.map(pane => pane.canvas.clientWidth); out.metrics = $("metrics").width > 500;
      const there = two.simulated(1, 0, 12), at = camera.toScreen(there.x, there.y), { canvas } = panes[1];
      const box = canvas.getBoundingClientRect(), where = { clientX: box.left + at[0], clientY: box.top + at[1] };
      canvas.setPointerCapture = () => 0;  // of a pointer that there is
      for (const kind of ["pointerdown", "pointerup"]) canvas.dispatchEvent(new PointerEvent(kind, where));
      out.clicked = [panes.indexOf(shown), view.agent, $("events").textContent];
      out.plan = [two.plan(1, 4), two.plan(1, 5, 1), two.plan(1, 5), two.plan(0, 4), one.plan(1, 4)];
      out.ttc = Array.from({ length: 12 }, (_, t) => one.collisionIn(1, 0, t)).map(x => Number.isNaN(x) ? null : x);
      out.away = METRICS[3][1](one, 1, 0, 12); out.speed = METRICS[0][1](one, 1, 0, 12);
      const { x, time } = metricsLayout($("metrics"), two);
      out.back = Math.round(time(x(2, 7)));
      await open(1); choose(0); out.legend = $("legend").parentNode.tagName;
    """
    out = driven_page(tmp_path, script, [hits, calm, other, same], planners=2)
    assert out["names"] == ["made <i> 0", "made <i> 1"]
    assert out["kinds"][0] == [[[], ["collision", "fault"]], [["failed"], []]]
    assert out["filters"] == ["", "collision", "fault", "failed"]
    both, first = [hits.segment.segment_id, "other"], [hits.segment.segment_id]
    assert (out["all"], out["fault"], out["failed"]) == (
        [both, ["0", "1"], 0, 0], [first, ["1"], 0, 1], [first, ["0"], 0, 0],
    )  # fmt: skip
    np.testing.assert_allclose(out["x"], [one.state[1, 12, 0, 0] for one in (hits, calm)], atol=1e-3)
    assert min(out["drawn"]) > 20
    assert out["wide"][0] == pytest.approx(out["wide"][1], abs=2)
    assert (*out["clicked"][:2], out["back"], out["legend"], out["metrics"]) == (1, 0, 7, "ASIDE", True)
    assert "none in this rollout" in out["clicked"][2]
    np.testing.assert_allclose(out["plan"][0], plan[1, 0, 4, :2], atol=0.006)
    assert out["plan"][1:] == [[[7, 8]], [], [], []]
    add_segment(report := Report("made", "interactive"), hits)
    expected = [None, *(float(x) if x < 10 else None for x in report.collision_in[both[0]][1, :11, 0])]
    assert any(out["ttc"])
    assert out["ttc"] == [None if x is None else pytest.approx(x, abs=0.021) for x in expected]
    log = hits.segment.position[0, 12, :2]
    assert out["away"] == pytest.approx(np.linalg.norm(hits.state[1, 12, 0, :2] - log), abs=2e-3)
    assert out["speed"] == pytest.approx(hits.state[1, 12, 0, 3], abs=0.006)


@pytest.mark.slow
def test_what_is_drawn_is_seen(tmp_path: Path) -> None:
    for name in ("sim", "other"):
        save_rollouts(tmp_path / name, ABOUT, [crash()])
    assert main(["view", str(tmp_path / "sim"), str(tmp_path / "other")]) == 0
    shot, page = tmp_path / "shot.png", tmp_path / "sim" / "view.html"
    browse(page, f"--screenshot={shot}", "--virtual-time-budget=8000", place="#rollout=1&t=2.4&follow=ego")
    with Image.open(shot) as image:
        halves = np.asarray(image.convert("RGB"))[80:560, :880].reshape(480, 2, 440, 3).swapaxes(0, 1)
    for color in ((0x00, 0x72, 0xB2), (0xA9, 0xAE, 0xB5), (0xB3, 0x12, 0x2B), (0xF3, 0xF1, 0xEC)):
        assert ((np.abs(halves.astype(int) - color).max(-1) < 6).sum((1, 2)) > 40).all(), color
