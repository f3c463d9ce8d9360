// Segments as they are packed in the page: deflated bytes in base64, unpacked when they are first shown.
const TYPES = { i32: Int32Array, i16: Int16Array, u8: Uint8Array, f32: Float32Array };

function fromBase64(text) {
  const raw = atob(text), bytes = new Uint8Array(raw.length);
  for (let i = 0; i < raw.length; i++) bytes[i] = raw.charCodeAt(i);
  return bytes;
}

async function inflate(bytes) {
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return await new Response(stream).arrayBuffer();
}

// Numbers in metres and so on from integers; along the last axis they may be differences.
function decode(buffer, start, item) {
  const count = item.shape.reduce((a, b) => a * b, 1);
  const raw = new TYPES[item.type](buffer, start + item.offset, count);
  if (!item.scale && !item.delta) return raw;
  const out = item.scale ? new Float64Array(count) : new Int32Array(count);
  const length = item.shape[item.shape.length - 1] || 1, scale = item.scale || 1;
  for (let i = 0, sum = 0; i < count; i++) {
    sum = item.delta && i % length ? sum + raw[i] : raw[i];
    out[i] = sum * scale;
  }
  return out;
}

// A block of the page; null where there is none.
async function unpack(id) {
  const block = document.getElementById(id);
  if (!block) return null;
  const buffer = await inflate(fromBase64(block.textContent));
  const length = new DataView(buffer).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  const data = { ...header.facts }, start = 4 + length;
  for (const item of header.arrays) data[item.name] = decode(buffer, start, item);
  return data;
}

// One segment: what was logged and what one planner made of it, by agent, rollout and time.
class Replay {
  constructor(data) {
    Object.assign(this, data);
    this.states = this.steps + 1;
    // Past the end of the log, those that are driven here have none.
    const seen = this["log.valid"] = this["log.valid"].slice();
    for (const row of this.agents) seen.fill(0, row * this.states + Math.min(this.log_end + 1, this.states), (row + 1) * this.states);
    this.rank = new Map(Array.from(this.agents, (row, n) => [row, n]));
    const others = Array.from(this.agents).filter(row => row !== this.ego);
    // The first is the ego's alone.
    this.color = row => row === this.ego ? PALETTE[0] : !this.rank.has(row) ? PLAYBACK : PALETTE[1 + others.indexOf(row) % (PALETTE.length - 1)];
  }

  // What a driven agent is: one that is evaluated, or background that drives by a rule.
  kind(row) {
    if (row === this.ego) return "ego";
    return (this.drivers[this.rank.get(row)] || "").startsWith("background:") ? "background" : "interactive";
  }

  // State at time t (in steps) from arrays of so many states; null where the agent isn't there.
  at(prefix, index, t) {
    const i = Math.min(Math.floor(t), this.states - 1), f = t - i, a = index * this.states + i;
    const seen = this[prefix + ".valid"];
    if (!seen[a]) return null;
    const x = this[prefix + ".x"], y = this[prefix + ".y"], h = this[prefix + ".h"], s = this[prefix + ".s"];
    if (f < 1e-6 || i + 1 >= this.states || !seen[a + 1]) return { x: x[a], y: y[a], h: h[a], s: s[a] };
    let turn = h[a + 1] - h[a];
    turn -= 2 * Math.PI * Math.round(turn / (2 * Math.PI));
    const mix = v => v[a] + f * (v[a + 1] - v[a]);
    return { x: mix(x), y: mix(y), h: h[a] + f * turn, s: mix(s) };
  }

  logged(row, t) { return this.at("log", row, t); }
  simulated(k, n, t) { return this.at("sim", k * this.agents.length + n, t); }
  state(k, row, t) { return this.rank.has(row) ? this.simulated(k, this.rank.get(row), t) : this.logged(row, t); }

  // Seconds to a collision at state t of a rollout; NaN where there is none in sight.
  collisionIn(k, row, t) {
    if (!this.ttc || !this.rank.has(row) || !t) return NaN;
    const seconds = this.ttc[(k * this.agents.length + this.rank.get(row)) * this.steps + t - 1];
    return seconds > 10.1 ? NaN : seconds;
  }
  // What the planner of driven agent n meant to come past, said at state t, as [x, y].
  plan(k, t, n = 0) {
    const counts = this["plan.count"] || [], planners = counts.length / (this.rollouts * this.steps);
    const at = (k * planners + n) * this.steps + t, count = n < planners && t < this.steps ? counts[at] : 0;
    const most = count && this["plan.x"].length / this["plan.count"].length;
    return Array.from({ length: count }, (_, h) => [this["plan.x"][at * most + h], this["plan.y"][at * most + h]]);
  }

  line(name, k) {
    const from = this[name + ".offsets"][k], to = this[name + ".offsets"][k + 1];
    return { from, to, x: this[name + ".x"], y: this[name + ".y"] };
  }
  lines(name) { return this[name + ".offsets"].length - 1; }
  route(k, row) {
    if (!this.rank.has(row)) return -1;
    return this.goal[k * this.agents.length + this.rank.get(row)];
  }
}
