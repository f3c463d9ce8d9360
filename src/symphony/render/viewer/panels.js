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

function speedChart(canvas, r, view) {
  const w = canvas.clientWidth || 290, h = 84, ratio = window.devicePixelRatio || 1, c = canvas.getContext("2d");
  canvas.width = w * ratio; canvas.height = h * ratio;
  c.setTransform(ratio, 0, 0, ratio, 0, 0);
  const row = view.agent, n = r.agents.length, driven = r.rank.has(row), own = [], log = [];
  for (let t = 0; t < r.states; t++) { const a = r.logged(row, t); log.push(a ? a.s : NaN); const b = driven ? r.simulated(view.rollout, r.rank.get(row), t) : a; own.push(b ? b.s : NaN); }
  const top = Math.max(5, ...own.filter(Number.isFinite), ...log.filter(Number.isFinite)) * 1.08, left = 30, bottom = h - 15;
  const x = t => left + (w - left - 4) * t / (r.states - 1), y = v => bottom - (bottom - 5) * Math.max(v, 0) / top;
  c.font = "11px system-ui, sans-serif"; c.fillStyle = "#5b616b"; c.strokeStyle = "#d9d6cf"; c.lineWidth = 1;
  const step = top > 20 ? 10 : top > 8 ? 5 : 2;
  for (let v = 0; v <= top; v += step) { c.beginPath(); c.moveTo(left, y(v)); c.lineTo(w - 4, y(v)); c.stroke(); c.textAlign = "right"; c.fillText(v, left - 5, y(v) + 4); }
  c.textAlign = "left"; c.fillText("speed, m/s", left, h - 3); c.textAlign = "right"; c.fillText(`${((r.states - 1) * r.dt).toFixed(0)} s`, w - 4, h - 3);
  const plot = (values, color, dash, width) => {
    c.strokeStyle = color; c.setLineDash(dash); c.lineWidth = width; c.beginPath();
    values.forEach((v, t) => Number.isFinite(v) ? (t && Number.isFinite(values[t - 1]) ? c.lineTo(x(t), y(v)) : c.moveTo(x(t), y(v))) : 0);
    c.stroke(); c.setLineDash([]);
  };
  if (driven) plot(log, INK, [4, 3], 1);
  plot(own, driven ? r.color(row) : "#5b616b", [], 1.8);
  c.strokeStyle = "#2b2f3688"; c.beginPath(); c.moveTo(x(view.t), 4); c.lineTo(x(view.t), bottom); c.stroke();
}

function eventText(r, event) {
  const who = r.ids[event.agent], other = event.other >= 0 ? r.ids[event.other] : "";
  if (event.kind === "collision") {
    const fault = event.fault === null ? "" : event.fault ? " <span class=\"fault\">at fault</span>" : " · not at fault";
    return `${escapeText(who)} and ${escapeText(other)}: ${escapeText(event.text)}${fault}`;
  }
  return `${escapeText(who)} ${escapeText(event.text)}`;
}
