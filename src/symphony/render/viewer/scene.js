// What moves: boxes, the ways they took, lights, events and branches of a search.
const PALETTE = ["#0072b2", "#d55e00", "#009e73", "#882255", "#332288", "#d9c400", "#ff80ff", "#9ade6b"];
const PLAYBACK = "#a9aeb5", INK = "#2b2f36", DARK = { 2: "#7d8794", 3: "#8b9097" };
const PLAN = "#b5179e";
const LIGHTS = { 1: "stop", 4: "stop", 7: "stop", 2: "caution", 5: "caution", 8: "caution", 3: "go", 6: "go" };
const LIGHT_COLORS = { stop: STOP, caution: "#e69f00", go: "#009e73" };

class Scene {
  constructor(replay) {
    this.replay = replay; this.map = new StaticMap(replay);
    this.colors = Array.from(replay.agents, row => replay.color(row));
  }

  draw(context, camera, view) {
    const r = this.replay, ratio = camera.ratio;
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    this.px = 1 / camera.scale;
    const { routes, rollouts, trails, log, lights, plan } = view.layers, one = routes ? view.agent : null;
    this.map.draw(context, camera, [view.rollout, one, routes, rollouts, trails, log].join(), onMap => {
      if (routes) this.routes(onMap, view);
      if (rollouts) this.waysOfOthers(onMap, view);
      if (trails) this.ways(onMap, view);
      if (log) this.logWays(onMap);
    });
    this.toWorld(context, camera);
    if (lights) this.lights(context, view);
    if (rollouts) this.otherRollouts(context, view);
    if (trails) this.trails(context, view);
    if (log) this.ghosts(context, view);
    for (let row = 0; row < r.size.length / 2; row++) {
      if (!r.rank.has(row)) this.box(context, row, r.logged(row, view.t), DARK[r.type[row]] || PLAYBACK, 1);
    }
    if (plan) r.agents.forEach((_, n) => this.plan(context, view, n));
    r.agents.forEach((row, n) => this.box(context, row, r.simulated(view.rollout, n, view.t), this.colors[n], 1));
    if (view.branch) this.branch(context, view);
    this.selection(context, view);
    this.events(context, view);
    if (view.layers.labels) this.labels(context, camera, view);
  }

  toWorld(context, camera) {
    const k = camera.scale * camera.ratio;
    context.setTransform(k, 0, 0, -k, camera.ratio * camera.width / 2 - camera.x * k, camera.ratio * camera.height / 2 + camera.y * k);
  }

  outline(context, row, state, grow = 0) {
    const r = this.replay, l = r.size[2 * row] / 2 + grow, w = r.size[2 * row + 1] / 2 + grow;
    const c = Math.cos(state.h), s = Math.sin(state.h);
    const at = (a, b) => [state.x + a * c - b * s, state.y + a * s + b * c];
    context.beginPath();
    for (const [a, b] of [[l, w], [l, -w], [-l, -w], [-l, w]]) context.lineTo(...at(a, b));
    context.closePath();
    return at;
  }

  box(context, row, state, color, alpha) {
    if (!state) return;
    const r = this.replay, at = this.outline(context, row, state);
    context.globalAlpha = alpha;
    context.fillStyle = color; context.fill();
    const ego = row === r.ego;
    context.strokeStyle = ego ? INK : "white"; context.lineWidth = (ego ? 2 : 0.8) * this.px; context.stroke();
    const l = r.size[2 * row], w = r.size[2 * row + 1];
    context.beginPath();
    for (const [a, b] of [[0.46, 0], [0.12, 0.36], [0.12, -0.36]]) context.lineTo(...at(a * l, b * w));
    context.closePath();
    context.fillStyle = "rgb(255 255 255 / 85%)"; context.fill();
    context.globalAlpha = 1;
  }

  ghosts(context, view) {
    const r = this.replay;
    context.strokeStyle = INK; context.lineWidth = 1.1 * this.px;
    for (const row of r.agents) {
      const state = r.logged(row, view.t);
      if (state) { this.outline(context, row, state); context.stroke(); }
    }
  }

  logWays(context) {
    const r = this.replay;
    context.strokeStyle = INK; context.lineWidth = 1.1 * this.px;
    context.setLineDash([5 * this.px, 3 * this.px]);
    for (const row of r.agents) this.way(context, "log", row, 0, r.states);
    context.setLineDash([]);
  }

  // The steps of one agent as a line, left out where it isn't there.
  way(context, prefix, index, from, to) {
    const r = this.replay, x = r[prefix + ".x"], y = r[prefix + ".y"], seen = r[prefix + ".valid"];
    context.beginPath();
    for (let t = from, pen = false; t < to; t++) {
      const i = index * r.states + t;
      if (seen[i]) pen ? context.lineTo(x[i], y[i]) : context.moveTo(x[i], y[i]);
      pen = seen[i];
    }
    context.stroke();
  }

  trails(context, view) {
    const r = this.replay, n = r.agents.length;
    // The last seconds; all of the way lies on the map, pale.
    const from = Math.max(0, Math.floor(view.t - 3 / r.dt));
    context.lineWidth = 2 * this.px;
    for (let i = 0; i < n; i++) {
      context.strokeStyle = this.colors[i];
      this.way(context, "sim", view.rollout * n + i, from, Math.floor(view.t) + 1);
    }
  }

  // What a planner meant to do when it was last asked.
  plan(context, view, n) {
    const r = this.replay, t = Math.min(Math.floor(view.t), r.steps - 1), points = r.plan(view.rollout, t, n), own = r.simulated(view.rollout, n, t);
    if (!points.length || !own) return;
    context.beginPath(); context.moveTo(own.x, own.y);
    for (const [x, y] of points) context.lineTo(x, y);
    for (const [color, width] of [["white", 4.5], [PLAN, 2]]) { context.strokeStyle = color; context.lineWidth = width * this.px; context.stroke(); }
    context.fillStyle = PLAN;
    for (const [x, y] of points) { context.beginPath(); context.arc(x, y, 2.6 * this.px, 0, 7); context.fill(); }
  }

  ways(context, view) {
    const r = this.replay, n = r.agents.length;
    context.lineWidth = 2 * this.px; context.globalAlpha = 0.3;
    for (let i = 0; i < n; i++) { context.strokeStyle = this.colors[i]; this.way(context, "sim", view.rollout * n + i, 0, r.states); }
    context.globalAlpha = 1;
  }

  waysOfOthers(context, view) {
    const r = this.replay, n = r.agents.length;
    context.globalAlpha = this.faint(); context.lineWidth = 1.2 * this.px;
    for (let k = 0; k < r.rollouts; k++) for (let i = 0; i < n && k !== view.rollout; i++) {
      context.strokeStyle = this.colors[i]; this.way(context, "sim", k * n + i, 0, r.states);
    }
    context.globalAlpha = 1;
  }

  faint() { return Math.min(0.5, 2.5 / Math.max(this.replay.rollouts, 1)); }

  otherRollouts(context, view) {
    const r = this.replay, n = r.agents.length;
    for (let k = 0; k < r.rollouts; k++) for (let i = 0; i < n && k !== view.rollout; i++) {
      this.box(context, r.agents[i], r.simulated(k, i, view.t), this.colors[i], this.faint());
    }
  }

  routes(context, view) {
    const r = this.replay;
    for (const row of r.agents) {
      const number = r.route(view.rollout, row);
      if (number < 0 || (view.agent !== null && r.rank.has(view.agent) && view.agent !== row)) continue;
      const line = r.line("routes", number), path = new Path2D();
      trace(path, line);
      context.globalAlpha = 0.22; context.strokeStyle = r.color(row); context.lineWidth = 2.6; context.lineCap = "round";
      context.stroke(path);
      const i = line.to - 1;
      context.globalAlpha = 0.9; context.lineWidth = 2 * this.px;
      context.beginPath(); context.arc(line.x[i], line.y[i], Math.max(1.3, 5 * this.px), 0, 7);
      context.fillStyle = "white"; context.fill(); context.stroke();
      context.beginPath(); context.arc(line.x[i], line.y[i], Math.max(0.5, 2 * this.px), 0, 7);
      context.fillStyle = r.color(row); context.fill();
    }
    context.globalAlpha = 1; context.lineCap = "butt";
  }

  lights(context, view) {
    const r = this.replay, count = r["lights.x"].length, t = Math.min(Math.floor(view.t), r.states - 1);
    const size = Math.max(0.7, 4.5 * this.px);
    for (let q = 0; q < count; q++) {
      const name = LIGHTS[r["lights.state"][q * r.states + t]], x = r["lights.x"][q], y = r["lights.y"][q];
      context.beginPath();
      // Shape as well as colour, so that they can be told apart without seeing red and green.
      if (name === "stop") context.rect(x - size, y - size, 2 * size, 2 * size);
      else if (name === "caution") for (const [a, b] of [[0, 1.3], [1.3, 0], [0, -1.3], [-1.3, 0]]) context.lineTo(x + a * size, y + b * size);
      else context.arc(x, y, size, 0, 7);
      context.closePath();
      context.fillStyle = LIGHT_COLORS[name] || "white"; context.fill();
      context.strokeStyle = name ? "white" : INK; context.lineWidth = this.px; context.stroke();
    }
  }

  branch(context, view) {
    const r = this.replay, n = r.agents.length, { steps, tree } = view.branch;
    for (let i = 0; i < n; i++) {
      context.beginPath();
      let pen = false;
      steps.forEach((slot, t) => {
        const a = ((tree * r.branches + slot) * n + i) * r.steps + t;
        if (r["tree.valid"][a]) pen ? context.lineTo(r["tree.x"][a], r["tree.y"][a]) : context.moveTo(r["tree.x"][a], r["tree.y"][a]);
        pen = r["tree.valid"][a];
      });
      context.strokeStyle = "white"; context.lineWidth = 5 * this.px; context.stroke();
      context.strokeStyle = view.branch.color; context.lineWidth = 2.6 * this.px; context.stroke();
      const now = Math.min(Math.floor(view.t) - 1, steps.length - 1);
      if (now >= 0) {
        const a = ((tree * r.branches + steps[now]) * n + i) * r.steps + now;
        if (!r["tree.valid"][a]) continue;
        this.outline(context, r.agents[i], { x: r["tree.x"][a], y: r["tree.y"][a], h: r["tree.h"][a] });
        context.lineWidth = 2 * this.px; context.stroke();
      }
    }
  }

  selection(context, view) {
    if (view.agent === null) return;
    const state = this.replay.state(view.rollout, view.agent, view.t);
    if (!state) return;
    this.outline(context, view.agent, state, 0.5 + 2 * this.px);
    context.strokeStyle = INK; context.lineWidth = 2 * this.px; context.stroke();
  }

  events(context, view) {
    for (const event of view.events) {
      if (event.step > view.t + 1e-6) continue;
      const state = this.replay.state(view.rollout, event.agent, event.step);
      if (!state) continue;
      const s = Math.max(0.8, 7 * this.px);
      const fresh = view.t - event.step < 1.5 / this.replay.dt;
      context.globalAlpha = fresh ? 1 : 0.55;
      context.lineCap = "round";
      for (const [color, width] of [["white", 5], [EVENT_COLORS[event.kind] || STOP, 2.6]]) {
        context.strokeStyle = color; context.lineWidth = width * this.px; context.beginPath();
        if (event.kind === "collision") {
          context.moveTo(state.x - s, state.y - s); context.lineTo(state.x + s, state.y + s);
          context.moveTo(state.x - s, state.y + s); context.lineTo(state.x + s, state.y - s);
          if (fresh) { context.moveTo(state.x + 2.2 * s, state.y); context.arc(state.x, state.y, 2.2 * s, 0, 7); }
        } else {
          context.moveTo(state.x, state.y + s); context.lineTo(state.x + s, state.y - s);
          context.lineTo(state.x - s, state.y - s); context.closePath();
        }
        context.stroke();
      }
    }
    context.globalAlpha = 1; context.lineCap = "butt";
  }

  labels(context, camera, view) {
    const r = this.replay;
    context.setTransform(camera.ratio, 0, 0, camera.ratio, 0, 0);
    context.font = "11px system-ui, sans-serif"; context.textAlign = "center"; context.lineWidth = 3; context.strokeStyle = "white"; context.fillStyle = INK;
    for (let row = 0; row < r.size.length / 2; row++) {
      const state = r.state(view.rollout, row, view.t);
      if (!state) continue;
      const [x, y] = camera.toScreen(state.x, state.y);
      context.strokeText(r.ids[row], x, y - 9); context.fillText(r.ids[row], x, y - 9);
    }
  }

  // The agent at a place, or null; near ones count when nothing is hit.
  pick(view, x, y) {
    let best = null, least = Math.max(1.5, 10 * this.px);
    for (let row = 0; row < this.replay.size.length / 2; row++) {
      const state = this.replay.state(view.rollout, row, view.t);
      if (!state) continue;
      const c = Math.cos(state.h), s = Math.sin(state.h), dx = x - state.x, dy = y - state.y;
      const a = Math.abs(dx * c + dy * s) - this.replay.size[2 * row] / 2, b = Math.abs(dy * c - dx * s) - this.replay.size[2 * row + 1] / 2;
      const gap = Math.hypot(Math.max(a, 0), Math.max(b, 0)) + (Math.max(a, b) < 0 ? -1 : 0);
      if (gap < least) { least = gap; best = row; }
    }
    return best;
  }
}
