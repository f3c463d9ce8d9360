// The page: what is shown, and what the user does.
const $ = id => document.getElementById(id);
const about = JSON.parse($("about").textContent);
const camera = new Camera();
const LAYERS = { log: "log ghosts", routes: "routes, goals", trails: "ways", rollouts: "other rollouts", plan: "plan", lights: "lights", labels: "ids" };
const FILTERS = { "": "any events", collision: "a collision", fault: "a collision at fault", offroad: "time off the road", redlight: "a red light run", blocking: "blocked traffic", failed: "a failure" };
const view = { segment: 0, rollout: 0, t: 0, playing: false, speed: 1, agent: null, follow: null, events: [], branch: null, filter: "",
  layers: { log: true, routes: true, trails: true, rollouts: false, plan: true, lights: true, labels: false } };
// Those whose rollouts are shown side by side; `shown`, `scene` and `search` are of the one that was clicked last.
const panes = about.names.map((name, p) => {
  const box = document.createElement("div"), canvas = document.createElement("canvas");
  box.className = "pane"; canvas.tabIndex = 0; canvas.setAttribute("aria-label", `Replay of ${name}`);
  box.append(canvas);
  if (about.names.length > 1) box.insertAdjacentHTML("beforeend", `<h3><b style="background:${PALETTE[p % PALETTE.length]}"></b>${escapeText(name)}</h3>`);
  $("panes").append(box);
  return { name, box, canvas, context: canvas.getContext("2d"), color: PALETTE[p % PALETTE.length], scene: null, events: [] };
});
let shown = panes[0], scene = null, search = null, dirty = true, last = 0;
const cache = new Map();

async function scenesOf(segment) {
  const log = await unpack(`segment-${segment}`), blocks = await Promise.all(panes.map((_, p) => unpack(`segment-${segment}-${p}`)));
  return blocks.map(block => block && new Scene(new Replay({ ...log, ...block })));
}

async function open(segment, wanted = {}) {
  view.segment = segment;
  if (!cache.has(segment)) {
    if (cache.size > 12) cache.delete(cache.keys().next().value);
    cache.set(segment, await scenesOf(segment));
  }
  if (view.segment !== segment) return;
  panes.forEach((pane, p) => { pane.scene = cache.get(segment)[p]; });
  view.agent = null; view.follow = null; view.branch = null;
  show(shown.scene ? shown : panes.find(pane => pane.scene));
  const r = scene.replay;
  $("segment").value = segment;
  $("facts").textContent = `${r.source} · ${(r.steps * r.dt).toFixed(1)} s at ${+(1 / r.dt).toFixed(2)} Hz · ${r.size.length / 2} agents, ${r.agents.length} driven`;
  $("time").max = r.steps;
  $("follow").innerHTML = `<option value="">nobody</option>` + Array.from(new Set([r.ego, ...r.agents]), row => `<option value="${row}">${followName(r, row)}</option>`).join("");
  resize();
  fit();
  seek(wanted.step || 0);
  const numbers = rolloutsWith(segment);
  choose(numbers.includes(wanted.rollout) ? wanted.rollout : numbers[0] || 0);
  if (wanted.agent !== undefined) select(wanted.agent);
}

// The one of the panes that the panels beside the map are about.
function show(pane) {
  shown = pane; scene = pane.scene;
  const r = scene.replay;
  panes.forEach(one => one.box.classList.toggle("active", one === pane));
  $("rollout").innerHTML = rolloutsWith(view.segment).map(k => `<option value="${k}">${k}${rolloutNote(r, k)}</option>`).join("");
  search = r.branches ? new SearchPanel(r, $("tree")) : null;
  $("search").hidden = !search;
  legend(r);
}

// Numbers of the rollouts of a segment in which, for any planner, there is what is asked for.
function rolloutsWith(segment) {
  const kinds = about.segments[segment].kinds.filter(one => one), most = Math.max(...kinds.map(one => one.length));
  return Array.from({ length: most }, (_, k) => k).filter(k => !view.filter || kinds.some(one => one[k] && one[k].includes(view.filter)));
}
function listSegments() {
  const numbers = about.segments.map((_, i) => i).filter(i => rolloutsWith(i).length);
  $("segment").innerHTML = numbers.map(i => `<option value="${i}">${escapeText(about.segments[i].id)}</option>`).join("");
  return numbers;
}

const followName = (r, row) => `${r.rank.has(row) || row === r.ego ? r.kind(row) : "agent"} ${escapeText(r.ids[row])}`;
function rolloutNote(r, k) {
  const found = r.events.filter(e => e.rollout === k);
  const hits = found.filter(e => e.kind === "collision");
  if (r.failed[k]) return " · failed";
  return hits.length ? (hits.some(e => e.fault) ? " · collision, at fault" : " · collision") : found.length ? ` · ${found[0].label}` : "";
}

function choose(rollout) {
  view.rollout = rollout; view.branch = null;
  for (const pane of panes) pane.events = pane.scene ? pane.scene.replay.events.filter(e => e.rollout === rollout).sort((a, b) => a.step - b.step) : [];
  if (!has(shown)) show(panes.find(has));
  const r = scene.replay;
  view.events = shown.events;
  $("rollout").value = rollout;
  $("eventcount").textContent = view.events.length ? `(${view.events.length})` : "";
  $("events").innerHTML = (r.failed[rollout] ? `<li class="fault">broke off: ${escapeText(r.failed[rollout])}</li>` : "") +
    (view.events.map((e, i) => `<li tabindex="0" data-event="${i}"><time>${(e.step * r.dt).toFixed(1)} s</time><span>${eventText(r, e)}</span></li>`).join("") || "<span class=hint>none in this rollout</span>");
  $("ticks").innerHTML = view.events.map(e => `<i class="${e.kind}" style="left:${100 * e.step / r.steps}%"></i>`).join("") +
    (r.log_end < r.steps ? `<i class="logend" title="end of the log" style="left:${100 * r.log_end / r.steps}%"></i>` : "");
  $("branch").textContent = "Click a branch to see where it went and what became of it.";
  if (search) $("searchfacts").textContent = `tree ${search.treeOf(rollout)}: ${r.branches} branches, pruned every ${(r.prune_every * r.dt).toFixed(1)} s`;
  remember(); dirty = true;
}
const has = pane => pane.scene && view.rollout < pane.scene.replay.rollouts;

function seek(t) { view.t = Math.min(Math.max(+t.toFixed(6), 0), scene.replay.steps); dirty = true; }
function select(row) {
  view.agent = row;
  if (row !== null && view.follow !== null) view.follow = row;
  dirty = true; remember();
}
function play(on) {
  if (on && view.t >= scene.replay.steps) seek(0);
  view.playing = on; $("play").textContent = on ? "❚❚" : "▶"; last = 0; dirty = true;
  if (!on) remember();
}
function jump(i) {
  const event = view.events[i];
  if (!event) return;
  play(false); seek(event.step); select(event.agent);
  const state = scene.replay.state(view.rollout, event.agent, event.step);
  if (state) { camera.x = state.x; camera.y = state.y; camera.scale = Math.max(camera.scale, 9); }
}
function remember() {
  if (!scene) return;
  const place = new URLSearchParams({ segment: scene.replay.id, rollout: view.rollout, t: (view.t * scene.replay.dt).toFixed(2) });
  if (view.agent !== null) place.set("agent", scene.replay.ids[view.agent]);
  if (view.follow !== null) place.set("follow", scene.replay.ids[view.follow]);
  history.replaceState(null, "", "#" + place);
}
function fit() {
  const r = scene.replay;
  let box = [Infinity, -Infinity, Infinity, -Infinity];
  const add = (x, y, seen) => { for (let i = 0; i < x.length; i++) if (seen[i]) box = [Math.min(box[0], x[i]), Math.max(box[1], x[i]), Math.min(box[2], y[i]), Math.max(box[3], y[i])]; };
  for (const pane of panes) if (pane.scene) { const s = pane.scene.replay; add(s["sim.x"], s["sim.y"], s["sim.valid"]); }
  if (!Number.isFinite(box[0])) add(r["log.x"], r["log.y"], r["log.valid"]);
  const m = 22;
  camera.fit([box[0] - m, box[1] + m, box[2] - m, box[3] + m]);
  dirty = true;
}
function resize() {
  camera.width = shown.canvas.clientWidth; camera.height = shown.canvas.clientHeight; camera.ratio = window.devicePixelRatio || 1;
  for (const { canvas } of panes) { canvas.width = Math.round(camera.width * camera.ratio); canvas.height = Math.round(camera.height * camera.ratio); }
  dirty = true;
}
// The camera as a pane has it: with the agent that is followed in its middle.
function aim(pane) {
  const state = view.follow === null ? null : pane.scene.replay.state(view.rollout, view.follow, view.t);
  if (state) { camera.x = state.x; camera.y = state.y; }
}
function paint() {
  for (const pane of panes) if (pane !== shown) draw(pane);
  draw(shown);
}
function draw(pane) {
  const { canvas, context, events } = pane;
  if (!has(pane)) { context.setTransform(1, 0, 0, 1, 0, 0); context.clearRect(0, 0, canvas.width, canvas.height); return; }
  aim(pane);
  pane.scene.draw(context, camera, pane === shown ? view : { ...view, events, branch: null });
}
function legend(r) {
  const rows = Array.from(new Set([r.ego, ...r.agents])).filter(row => r.rank.has(row));
  const entries = rows.slice(0, 8).map(row => `<div><b style="background:${r.color(row)}"${row === r.ego ? " class=ego" : ""}></b>${r.kind(row)} ${TYPE_NAMES[r.type[row]]} ${escapeText(r.ids[row])}</div>`);
  if (rows.length > 8) entries.push(`<div>and ${rows.length - 8} more driven</div>`);
  entries.push(`<div><b style="background:${PLAYBACK}"></b>playback</div>`, `<div><b class="dash"></b>log</div>`);
  const sign = (text, color, what) => `<div><i style="color:${color}">${text}</i>${what}</div>`, kinds = Array.from(r["marks.type"]);
  if (r["lights.x"].length) for (const [name, text] of [["stop", "■"], ["caution", "◆"], ["go", "●"]]) entries.push(sign(text, LIGHT_COLORS[name], `light: ${name}`));
  if (kinds.includes(MARKS.sign)) entries.push(sign("○", STOP, "stop sign"));
  if (kinds.includes(MARKS.crosswalk)) entries.push(sign("▭", "#9a958c", "crosswalk"));
  const all = panes.filter(pane => pane.scene).map(pane => pane.scene.replay), happens = kind => all.some(one => one.events.some(e => e.kind === kind));
  if (all.some(one => one["plan.count"])) entries.push(sign("⋯", PLAN, "plan"));
  if (r.lines("routes")) entries.push(sign("◎", INK, "end of a route, the goal"));
  if (happens("collision")) entries.push(sign("×", STOP, "collision"));
  if (happens("offroad")) entries.push(sign("△", EVENT_COLORS.offroad, "off the road"));
  if (happens("redlight")) entries.push(sign("△", STOP, "red light run"));
  if (happens("blocking")) entries.push(sign("△", EVENT_COLORS.blocking, "blocks traffic"));
  $("legend").innerHTML = entries.join("");
}

function whoPanel() {
  const r = scene.replay, row = view.agent;
  if (row === null) { $("who").innerHTML = `<h2>Agent</h2><p class="hint">Click an agent, or use Tab.</p>`; return; }
  const color = r.rank.has(row) ? r.color(row) : PLAYBACK;
  const facts = describeAgent(r, view).map(([a, b]) => `<dt>${a}</dt><dd>${escapeText(b)}</dd>`).join("");
  const held = $("who").querySelector("dl");
  if (!held || held.dataset.row !== String(row)) {
    $("who").innerHTML = `<h2>Agent</h2><div><b class="swatch" style="background:${color}"></b><strong>${escapeText(r.ids[row])}</strong></div><dl data-row="${row}"></dl>`;
  }
  $("who").querySelector("dl").innerHTML = facts;
}

function scaleBar() {
  const raw = 110 / camera.scale, power = 10 ** Math.floor(Math.log10(raw)), length = [5, 2, 1].map(k => k * power).find(v => v <= raw);
  $("scale").querySelector("i").style.width = length * camera.scale + "px";
  $("scale").querySelector("span").textContent = `${length} m`;
}

function frame(now) {
  if (scene) {
    if (view.playing) {
      if (last) seek(view.t + (now - last) / 1000 * view.speed / scene.replay.dt);
      last = now;
      if (view.t >= scene.replay.steps) play(false);
    }
    if (dirty) {
      dirty = false;
      paint();
      $("time").value = view.t;
      const r = scene.replay;
      $("clock").textContent = `${(view.t * r.dt).toFixed(1)} / ${(r.steps * r.dt).toFixed(1)} s${view.t > r.log_end ? ", past the log" : ""}`;
      $("follow").value = view.follow === null ? "" : view.follow;
      document.querySelectorAll("#events li[data-event]").forEach(li => li.classList.toggle("now", Math.abs(view.events[li.dataset.event].step - view.t) * r.dt < 0.5));
      whoPanel(); scaleBar();
      const row = view.agent === null ? r.ego : view.agent, alone = panes.length === 1 && r.color(row);
      drawMetrics($("metrics"), panes.filter(has).map(pane => ({ replay: pane.scene.replay, rollout: view.rollout, color: alone || pane.color, events: pane.events })), row, view.t);
      if (search) search.draw(view);
    }
  }
  requestAnimationFrame(frame);
}

// Mouse and touch: drag, wheel, two fingers, click.
const pointers = new Map();
let moved = 0;
const place = event => { const box = event.currentTarget.getBoundingClientRect(); return [event.clientX - box.left, event.clientY - box.top]; };
function move(event) {
  const before = pointers.get(event.pointerId);
  if (!before) return;
  const now = place(event), other = [...pointers].find(([id]) => id !== event.pointerId);
  if (other) camera.zoom(Math.hypot(now[0] - other[1][0], now[1] - other[1][1]) / Math.max(1, Math.hypot(before[0] - other[1][0], before[1] - other[1][1])), ...other[1]);
  else { camera.x -= (now[0] - before[0]) / camera.scale; camera.y += (now[1] - before[1]) / camera.scale; }
  moved += Math.hypot(now[0] - before[0], now[1] - before[1]);
  if (moved > 4) view.follow = null;
  pointers.set(event.pointerId, now); dirty = true;
}
function pick(pane, event) {
  if (!has(pane)) return;
  if (pane !== shown) { show(pane); choose(view.rollout); }
  aim(pane);
  select(scene.pick(view, ...camera.toWorld(...place(event))));
}
for (const pane of panes) {
  const { canvas } = pane, release = event => {
    if (pointers.delete(event.pointerId) && event.type === "pointerup" && moved < 4) pick(pane, event);
    canvas.classList.remove("dragging");
  };
  canvas.addEventListener("pointerdown", event => { canvas.setPointerCapture(event.pointerId); pointers.set(event.pointerId, place(event)); moved = 0; canvas.classList.add("dragging"); });
  canvas.addEventListener("pointermove", move);
  canvas.addEventListener("pointerup", release);
  canvas.addEventListener("pointercancel", release);
  canvas.addEventListener("wheel", event => {
    event.preventDefault();
    const at = view.follow === null ? place(event) : [camera.width / 2, camera.height / 2];
    camera.zoom(Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.0015)), ...at); dirty = true;
  }, { passive: false });
}
$("metrics").onclick = event => { play(false); seek(Math.round(metricsLayout($("metrics"), scene.replay).time(event.offsetX))); remember(); };
const zoomBy = factor => { camera.zoom(factor, camera.width / 2, camera.height / 2); dirty = true; };
$("closer").onclick = () => zoomBy(1.4); $("wider").onclick = () => zoomBy(1 / 1.4); $("fit").onclick = () => { view.follow = null; fit(); };

$("play").onclick = () => play(!view.playing);
const stepBy = d => { play(false); seek(d > 0 ? Math.floor(view.t + 1e-6) + 1 : Math.ceil(view.t - 1e-6) - 1); remember(); };
$("back").onclick = () => stepBy(-1); $("forth").onclick = () => stepBy(1);
$("time").oninput = event => { play(false); seek(+event.target.value); };
$("time").onchange = remember;
$("speed").onchange = event => { view.speed = +event.target.value; };
function follow(row) {
  view.follow = row < 0 ? null : row;
  if (view.follow !== null) { camera.scale = Math.max(camera.scale, 6); if (view.agent === null) select(row); }
  dirty = true; remember();
}
$("follow").onchange = event => { const row = event.target.value === "" ? -1 : +event.target.value; follow(row); if (row >= 0) select(row); };
$("segment").onchange = event => open(+event.target.value).catch(complain);
const neighbour = d => { const all = listed, i = all.indexOf(view.segment); open(all[(i + d + all.length) % all.length]).catch(complain); };
$("previous").onclick = () => neighbour(-1); $("following").onclick = () => neighbour(1);
let listed = [];
$("filter").innerHTML = Object.entries(FILTERS).filter(([kind]) => !kind || about.segments.some(one => one.kinds.some(of => of && of.some(found => found.includes(kind))))).map(([kind, text]) => `<option value="${kind}">${text}</option>`).join("");
$("filter").onchange = event => { view.filter = event.target.value; listed = listSegments(); open(listed.includes(view.segment) ? view.segment : listed[0], { rollout: view.rollout }).catch(complain); };
$("rollout").onchange = event => choose(+event.target.value);
$("events").onclick = event => { const li = event.target.closest("[data-event]"); if (li) jump(+li.dataset.event); };
$("events").onkeydown = event => { if (event.key === "Enter") event.target.click(); };
$("tree").onclick = event => {
  const found = search.pick(event.offsetX, event.offsetY);
  if (!found) return;
  const same = view.branch && view.branch.p === found.p && view.branch.s === found.s;
  view.branch = same ? null : search.branch(view.rollout, found.p, found.s);
  $("branch").innerHTML = same ? "Click a branch to see where it went and what became of it." :
    `<b style="color:${BRANCH}">${view.branch.title}</b>: ${view.branch.fate}; ${view.branch.why}`;
  if (!same) { play(false); seek(view.branch.steps.length); }
  dirty = true;
};
$("layers").innerHTML = Object.entries(LAYERS).map(([name, text]) => `<label><input type="checkbox" data-layer="${name}"${view.layers[name] ? " checked" : ""}> ${text}</label>`).join("");
$("layers").onchange = event => { view.layers[event.target.dataset.layer] = event.target.checked; dirty = true; };

const speeds = Array.from($("speed").options, option => option.value);
const faster = d => { const i = speeds.indexOf($("speed").value) + d; if (speeds[i]) { $("speed").value = speeds[i]; view.speed = +speeds[i]; } };
function tab(d) { const rows = Array.from(scene.replay.agents), i = rows.indexOf(view.agent); select(rows[(i + d + rows.length) % rows.length]); }
const KEYS = { " ": () => play(!view.playing), ArrowRight: () => stepBy(1), ArrowLeft: () => stepBy(-1), "+": () => zoomBy(1.3), "=": () => zoomBy(1.3), "-": () => zoomBy(1 / 1.3),
  0: () => { view.follow = null; fit(); }, "]": () => faster(1), "[": () => faster(-1), Escape: () => select(null),
  f: () => { view.follow = view.follow === null ? (view.agent === null ? scene.replay.ego : view.agent) : null; dirty = true; },
  n: () => jump(view.events.findIndex(e => e.step > view.t + 1e-6)), p: () => jump(view.events.findLastIndex(e => e.step < view.t - 1e-6)) };
document.addEventListener("keydown", event => {
  if (event.ctrlKey || event.metaKey || event.altKey || event.target.tagName === "SELECT" || !scene) return;
  if (event.key === "Tab" && event.target === shown.canvas) { event.preventDefault(); tab(event.shiftKey ? -1 : 1); return; }
  if ((event.target.tagName === "BUTTON" || event.target.type === "checkbox") && event.key === " ") return;
  if (event.target.type === "range" && event.key.startsWith("Arrow")) event.preventDefault();
  const action = KEYS[event.key];
  if (action) { action(); event.preventDefault(); }
});
new ResizeObserver(() => { resize(); if (scene) paint(); }).observe($("panes"));  // a canvas of another size is empty

function complain(error) { $("message").hidden = false; $("message").textContent = `This page can't be shown: ${error.message || error}`; }
function fromPlace() {
  const wanted = new URLSearchParams(location.hash.slice(1)), found = about.segments.findIndex(one => one.id === wanted.get("segment"));
  const segment = Math.max(found, 0);
  if (!listed.includes(segment)) { view.filter = $("filter").value = ""; listed = listSegments(); }
  return open(segment, { rollout: +wanted.get("rollout") || 0 }).then(() => {
    seek((+wanted.get("t") || 0) / scene.replay.dt);
    const ids = scene.replay.ids, who = wanted.get("follow"), row = ids.indexOf(wanted.get("agent"));
    if (row >= 0) select(row);
    follow(who === "ego" ? scene.replay.ego : ids.indexOf(who));
  });
}
if (panes.length === 1) $("agent").textContent = about.names[0];
else document.querySelector("aside").append($("legend"));
listed = listSegments();
window.addEventListener("hashchange", () => fromPlace().catch(complain));
if (!about.segments.length) complain("it holds no rollouts");
else fromPlace().then(() => { document.body.dataset.ready = "1"; }).catch(complain);
requestAnimationFrame(frame);
