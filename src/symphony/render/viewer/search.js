// The branches of a search: periods from left to right, slots from top to bottom, coloured by their scores.
const SCALE = [[0, 114, 178], [214, 214, 205], [213, 94, 0]];

function scoreColor(f) {
  const at = Math.min(Math.max(f, 0), 1) * 2, i = Math.min(Math.floor(at), 1), g = at - i;
  return `rgb(${SCALE[i].map((c, j) => Math.round(c + g * (SCALE[i + 1][j] - c))).join(" ")})`;
}

class SearchPanel {
  constructor(replay, canvas) {
    this.replay = replay; this.canvas = canvas;
    const r = replay;
    this.periods = r.periods; this.branches = r.branches; this.leaves = r.leaves;
    this.total = (tree, p, s) => r["tree.totals"][(tree * r.periods + p) * r.branches + s];
    this.parent = (tree, p, s) => r["tree.parents"][(tree * r.periods + p) * r.branches + s];
    this.slot = (tree, p, l) => r["tree.slots"][(tree * r.periods + p) * r.leaves + l];
  }

  treeOf(rollout) { return Math.floor(rollout / this.leaves); }
  continued(tree, p, s) {
    const found = [];
    for (let c = 0; c < this.branches; c++) if (this.parent(tree, p, c) === s) found.push(c);
    return found;
  }
  rollouts(tree, p, s) {
    const found = [];
    for (let l = 0; l < this.leaves; l++) if (this.slot(tree, p, l) === s) found.push(tree * this.leaves + l);
    return found;
  }
  ranked(tree, p) {
    return Array.from({ length: this.branches }, (_, s) => s).sort((a, b) => this.total(tree, p, a) - this.total(tree, p, b));
  }
  // The slot of every step of a branch's history up to the end of a period.
  history(tree, p, s) {
    const slots = [];
    for (let q = p; q >= 0; q--) { slots[q] = s; if (q) s = this.parent(tree, q - 1, s); }
    const end = Math.min((p + 1) * this.replay.prune_every, this.replay.steps);
    return Array.from({ length: end }, (_, t) => slots[Math.floor(t / this.replay.prune_every)]);
  }

  fate(tree, p, s) {
    const used = this.rollouts(tree, p, s), kept = this.continued(tree, p, s), order = this.ranked(tree, p);
    const own = this.total(tree, p, s), text = v => v.toFixed(2), rank = 1 + order.filter(c => this.total(tree, p, c) < own).length;
    const place = `total ${text(own)}, ${rank === 1 ? "the best" : `number ${rank}`} of ${this.branches} (low is good)`;
    if (used.length) return ["kept", `${place}. Part of rollout${used.length > 1 ? "s" : ""} ${used.join(", ")}.`];
    const alive = order.filter(c => this.continued(tree, p, c).length), worst = alive.length ? this.total(tree, p, alive[alive.length - 1]) : NaN;
    if (kept.length) return ["died out", `${place}. Survived this pruning, continued in ${kept.length} slot${kept.length > 1 ? "s" : ""}, but none of these reached a rollout.`];
    const why = own > worst ? `the ${alive.length} that went on had totals of at most ${text(worst)}` :
      `the ${alive.length} that went on were drawn by their totals, and it was not among them`;
    return ["pruned", `${place}. Pruned: ${why}.`];
  }

  layout() {
    const width = this.canvas.clientWidth || 290, row = Math.max(5, Math.min(13, 230 / this.branches));
    return { width, row, height: row * this.branches + 24, left: 4, step: (width - 8) / this.periods, top: 4 };
  }

  draw(view) {
    const { width, row, height, left, step, top } = this.layout(), ratio = window.devicePixelRatio || 1, tree = this.treeOf(view.rollout);
    this.canvas.style.height = height + "px";
    this.canvas.width = width * ratio; this.canvas.height = height * ratio;
    const c = this.canvas.getContext("2d");
    c.setTransform(ratio, 0, 0, ratio, 0, 0);
    const bar = step * 0.62, y = s => top + (s + 0.5) * row;
    for (let p = 0; p < this.periods; p++) {
      const values = Array.from({ length: this.branches }, (_, s) => this.total(tree, p, s)).filter(Number.isFinite);
      const low = Math.min(...values), high = Math.max(...values);
      if (p + 1 < this.periods) for (let s = 0; s < this.branches; s++) {
        const from = this.parent(tree, p, s), used = this.rollouts(tree, p + 1, s).length && this.rollouts(tree, p, from).length;
        c.strokeStyle = used ? "#6f6a62" : "#d9d6cf"; c.lineWidth = used ? 1.1 : 0.7; c.beginPath();
        c.moveTo(left + p * step + bar, y(from)); c.lineTo(left + (p + 1) * step, y(s)); c.stroke();
      }
      for (let s = 0; s < this.branches; s++) {
        const fate = this.rollouts(tree, p, s).length ? 2 : this.continued(tree, p, s).length ? 1 : 0;
        const mine = this.slot(tree, p, view.rollout - tree * this.leaves) === s;
        c.globalAlpha = [0.38, 0.7, 1][fate];
        c.fillStyle = scoreColor((this.total(tree, p, s) - low) / (high - low || 1));
        const thick = row * [0.34, 0.5, 0.72][fate];
        c.fillRect(left + p * step, y(s) - thick / 2, bar, thick);
        c.globalAlpha = 1;
        if (mine) { c.strokeStyle = INK; c.lineWidth = 1.4; c.strokeRect(left + p * step - 0.5, y(s) - thick / 2 - 0.5, bar + 1, thick + 1); }
        if (view.branch && view.branch.p === p && view.branch.s === s && view.branch.tree === tree) {
          c.strokeStyle = BRANCH; c.lineWidth = 2.2; c.strokeRect(left + p * step - 1.5, y(s) - row / 2, bar + 3, row);
        }
      }
    }
    const now = left + Math.min(view.t / this.replay.prune_every, this.periods) * step;
    c.strokeStyle = "#2b2f3688"; c.lineWidth = 1; c.beginPath(); c.moveTo(now, top); c.lineTo(now, height - 18); c.stroke();
    c.fillStyle = "#5b616b"; c.font = "11px system-ui, sans-serif"; c.textBaseline = "bottom";
    c.fillText("best", left, height); c.fillText("worst of its period", left + 92, height);
    for (let i = 0; i < 56; i++) { c.fillStyle = scoreColor(i / 55); c.fillRect(left + 30 + i, height - 11, 1.5, 7); }
  }

  pick(x, y) {
    const { row, left, step, top } = this.layout(), p = Math.floor((x - left) / step), s = Math.floor((y - top) / row);
    return p >= 0 && p < this.periods && s >= 0 && s < this.branches ? { p, s } : null;
  }

  // When in a period, and whose, the score of a branch was highest: its most unrealistic moment.
  peak(tree, p, s) {
    const r = this.replay, n = r.agents.length;
    let best = null;
    for (let i = 0; i < n; i++) for (let t = p * r.prune_every; t < Math.min((p + 1) * r.prune_every, r.steps); t++) {
      const a = ((tree * r.branches + s) * n + i) * r.steps + t, score = r["tree.score"][a];
      if (r["tree.valid"][a] && Number.isFinite(score) && (!best || score > best.score)) best = { score, agent: r.agents[i], step: t + 1 };
    }
    return best;
  }

  branch(rollout, p, s) {
    const tree = this.treeOf(rollout), [fate, reason] = this.fate(tree, p, s), peak = this.peak(tree, p, s), end = Math.min((p + 1) * this.replay.prune_every, this.replay.steps);
    const color = BRANCH, from = p * this.replay.prune_every * this.replay.dt;
    const why = reason + (peak ? ` Highest score: ${peak.score.toFixed(2)}, agent ${this.replay.ids[peak.agent]} at ${(peak.step * this.replay.dt).toFixed(1)} s.` : "");
    return { tree, p, s, steps: this.history(tree, p, s), color, fate, why, title: `Branch ${s}, ${from.toFixed(1)}–${(end * this.replay.dt).toFixed(1)} s` };
  }
}
const BRANCH = "#c2188f";
