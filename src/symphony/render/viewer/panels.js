// What is said about the agent that was clicked, and the list of events.
const TYPE_NAMES = ["unset", "vehicle", "pedestrian", "cyclist", "other"];
const escapeText = text => String(text).replace(/[&<>"]/g, c => ({ "&": "&amp;", "<": "&lt;", ">": "&gt;", '"': "&quot;" })[c]);

function role(r, row) {
  if (!r.rank.has(row)) return row === r.ego ? "ego, log playback" : "log playback";
  const driver = (r.drivers[r.rank.get(row)] || "").replace(/^background:/, "");
  return r.kind(row) + (driver ? `, driven by ${driver}` : "");
}

function describeAgent(r, view) {
  const row = view.agent, state = r.state(view.rollout, row, view.t), facts = [["type", TYPE_NAMES[r.type[row]]], ["role", role(r, row)]];
  facts.push(["size", `${r.size[2 * row].toFixed(1)} × ${r.size[2 * row + 1].toFixed(1)} m`]);
  if (state) {
    const before = r.state(view.rollout, row, Math.max(0, Math.floor(view.t) - 1)), here = r.state(view.rollout, row, Math.floor(view.t));
    const acceleration = before && here && view.t >= 1 ? (here.s - before.s) / r.dt : null;
    facts.push(["speed", `${state.s.toFixed(1)} m/s (${(3.6 * state.s).toFixed(0)} km/h)`]);
    facts.push(["acceleration", acceleration === null ? "–" : `${acceleration.toFixed(1)} m/s²`]);
    facts.push(["heading", `${Math.round(((state.h * 180 / Math.PI) % 360 + 360) % 360)}°`]);
    const log = r.logged(row, view.t);
    if (r.rank.has(row)) facts.push(["from the log", log ? `${Math.hypot(log.x - state.x, log.y - state.y).toFixed(1)} m` : "not logged"]);
  } else facts.push(["now", "not there"]);
  if (r.rank.has(row)) facts.push(["route", routeText(r, view.rollout, row)]);
  return facts;
}

function routeText(r, k, row) {
  const number = r.route(k, row);
  if (number < 0) return "none";
  const line = r.line("routes", number);
  let length = 0, turn = 0, last = null;
  for (let i = line.from + 1; i < line.to; i++) {
    const dx = line.x[i] - line.x[i - 1], dy = line.y[i] - line.y[i - 1], h = Math.atan2(dy, dx);
    length += Math.hypot(dx, dy);
    if (Math.hypot(dx, dy) < 1e-3) continue;
    if (last !== null) turn += h - last - 2 * Math.PI * Math.round((h - last) / (2 * Math.PI));
    last = h;
  }
  const way = Math.abs(turn) < 0.5 ? "straight on" : turn > 0 ? "left" : "right";
  return `${length.toFixed(0)} m, ${way}`;
}

// Below the map: what is measured of one agent over time, a line for each planner.
const METRICS = [
  ["speed, m/s", (r, k, row, t) => speedAt(r, k, row, t)],
  ["acceleration, m/s²", (r, k, row, t) => t ? (speedAt(r, k, row, t) - speedAt(r, k, row, t - 1)) / r.dt : NaN],
  ["time to collision, s", (r, k, row, t) => r.collisionIn(k, row, t)],
  ["from the log, m", (r, k, row, t) => { const a = r.state(k, row, t), b = r.logged(row, t); return a && b ? Math.hypot(a.x - b.x, a.y - b.y) : NaN; }],
];
function speedAt(r, k, row, t) { const state = r.state(k, row, t); return state ? state.s : NaN; }
const METRICS_HEIGHT = 104, LEFT = 34;

function metricsLayout(canvas, r) {
  const each = (canvas.clientWidth || 900) / METRICS.length;
  return { each, x: (i, t) => i * each + LEFT + (each - LEFT - 10) * t / r.steps, time: px => (px % each - LEFT) / (each - LEFT - 10) * r.steps };
}

// `lines`: of each planner its replay, rollout, colour and events.
function drawMetrics(canvas, lines, row, now) {
  const r = lines[0].replay, ratio = window.devicePixelRatio || 1, h = METRICS_HEIGHT, c = canvas.getContext("2d"), { each, x } = metricsLayout(canvas, r);
  canvas.width = each * METRICS.length * ratio; canvas.height = h * ratio;
  c.setTransform(ratio, 0, 0, ratio, 0, 0);
  c.font = "11px system-ui, sans-serif";
  METRICS.forEach(([name, value], i) => {
    const found = lines.map(line => Array.from({ length: r.states }, (_, t) => value(line.replay, line.rollout, row, t)));
    const log = i === 0 ? Array.from({ length: r.states }, (_, t) => { const a = r.logged(row, t); return a ? a.s : NaN; }) : [];
    const known = [...found.flat(), ...log].filter(Number.isFinite), low = Math.min(0, ...known), high = Math.max(low + 2, ...known);
    const y = v => h - 8 - (h - 30) * (v - low) / (high - low), step = [0.5, 1, 2, 5, 10, 20, 50, 100].find(s => (high - low) / s <= 4) || 200;
    c.fillStyle = "#5b616b"; c.textAlign = "left"; c.fillText(known.length ? name : `${name}: –`, i * each + LEFT, 12);
    c.strokeStyle = "#d9d6cf"; c.lineWidth = 1; c.textAlign = "right";
    for (let v = Math.ceil(low / step) * step; v <= high + 1e-9; v += step) {
      c.beginPath(); c.moveTo(x(i, 0), y(v)); c.lineTo(x(i, r.steps), y(v)); c.stroke(); c.fillText(+v.toFixed(1), x(i, 0) - 5, y(v) + 4);
    }
    const plot = (values, color, dash, width) => {
      c.strokeStyle = color; c.setLineDash(dash); c.lineWidth = width; c.beginPath();
      values.forEach((v, t) => Number.isFinite(v) ? (t && Number.isFinite(values[t - 1]) ? c.lineTo(x(i, t), y(v)) : c.moveTo(x(i, t), y(v))) : 0);
      c.stroke(); c.setLineDash([]);
    };
    plot(log, INK, [4, 3], 1);
    found.forEach((values, k) => plot(values, lines[k].color, [], 1.8));
    for (const line of lines) for (const event of line.events) if (event.agent === row) {
      c.fillStyle = EVENT_COLORS[event.kind] || STOP; c.beginPath(); c.arc(x(i, event.step), 20, 3, 0, 7); c.fill();
    }
    c.strokeStyle = "#2b2f3688"; c.beginPath(); c.moveTo(x(i, now), 18); c.lineTo(x(i, now), h - 8); c.stroke();
  });
}

function eventText(r, event) {
  const who = r.ids[event.agent], other = event.other >= 0 ? r.ids[event.other] : "";
  if (event.kind === "collision") {
    const fault = event.fault === null ? "" : event.fault ? " <span class=\"fault\">at fault</span>" : " · not at fault";
    return `${escapeText(who)} and ${escapeText(other)}: ${escapeText(event.text)}${fault}`;
  }
  return `${escapeText(who)} ${escapeText(event.text)}`;
}
