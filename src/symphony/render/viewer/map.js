// The static map: paths in metres made once for a segment, drawn to a canvas of its own once for a zoom.
const LAND = "#f3f1ec", ROAD = "#ffffff", LANE = "#c9cdd3", EDGE = "#6f6a62", MARK = "#dad6ce", STOP = "#b3122b";
const EVENT_COLORS = { offroad: "#e69f00", blocking: "#7b3294" };
const MARKS = { road: 1, crosswalk: 2, bump: 3, driveway: 4, sign: 5 };
const MARGIN = 0.35;

function trace(path, line, close) {
  for (let i = line.from; i < line.to; i++) i > line.from ? path.lineTo(line.x[i], line.y[i]) : path.moveTo(line.x[i], line.y[i]);
  if (close) path.closePath();
}

class StaticMap {
  constructor(replay) {
    this.surface = new Map();
    this.lanes = new Path2D(); this.arrows = new Path2D(); this.edges = new Path2D();
    this.marks = new Path2D(); this.areas = new Path2D(); this.signs = [];
    for (let k = 0; k < replay.lines("lanes"); k++) {
      const line = replay.line("lanes", k), width = replay["lanes.width"][k];
      if (!this.surface.has(width)) this.surface.set(width, new Path2D());
      trace(this.surface.get(width), line);
      trace(this.lanes, line);
      this.addArrows(line);
    }
    for (let k = 0; k < replay.lines("boundary"); k++) trace(this.edges, replay.line("boundary", k));
    for (let k = 0; k < replay.lines("marks"); k++) {
      const line = replay.line("marks", k), kind = replay["marks.type"][k];
      if (kind === MARKS.sign) this.signs.push([line.x[line.from], line.y[line.from]]);
      else if (kind >= MARKS.crosswalk && line.to - line.from > 2) trace(this.areas, line, true);
      else trace(this.marks, line);
    }
    this.canvas = document.createElement("canvas");
    this.drawn = 0;
  }

  addArrows(line) {
    let next = 7, along = 0;
    for (let i = line.from + 1; i < line.to; i++) {
      const dx = line.x[i] - line.x[i - 1], dy = line.y[i] - line.y[i - 1], length = Math.hypot(dx, dy);
      for (; length > 0 && along + length >= next; next += 14) {
        const f = (next - along) / length, x = line.x[i - 1] + f * dx, y = line.y[i - 1] + f * dy;
        const c = dx / length, s = dy / length;
        this.arrows.moveTo(x - 0.7 * c - 0.7 * s, y - 0.7 * s + 0.7 * c);
        this.arrows.lineTo(x, y);
        this.arrows.lineTo(x - 0.7 * c + 0.7 * s, y - 0.7 * s - 0.7 * c);
      }
      along += length;
    }
  }

  // Draw what the camera sees onto a context with pixel coordinates; `above` is what lies on the map and doesn't
  // move, of which `key` says when it has changed.
  draw(context, camera, key, above) {
    const w = camera.width * (1 + 2 * MARGIN), h = camera.height * (1 + 2 * MARGIN);
    const [ox, oy] = this.origin ? camera.toScreen(this.origin.x, this.origin.y) : [0, 0];
    const inside = this.origin && this.origin.scale === camera.scale && this.origin.w === w && this.origin.h === h
      && Math.abs(ox - camera.width / 2) <= MARGIN * camera.width && Math.abs(oy - camera.height / 2) <= MARGIN * camera.height;
    if (!inside || this.key !== key) this.render(camera, w, h, above);
    this.key = key;
    const [x, y] = camera.toScreen(this.origin.x, this.origin.y);
    context.drawImage(this.canvas, x - w / 2, y - h / 2, w, h);
  }

  render(camera, w, h, above) {
    this.origin = { x: camera.x, y: camera.y, scale: camera.scale, w, h };
    this.drawn++;
    const ratio = camera.ratio, context = this.canvas.getContext("2d"), scale = camera.scale;
    this.canvas.width = Math.round(w * ratio); this.canvas.height = Math.round(h * ratio);
    context.fillStyle = LAND;
    context.fillRect(0, 0, this.canvas.width, this.canvas.height);
    context.setTransform(scale * ratio, 0, 0, -scale * ratio, (w / 2 - camera.x * scale) * ratio, (h / 2 + camera.y * scale) * ratio);
    const px = 1 / scale;
    context.lineJoin = "round"; context.lineCap = "butt"; context.strokeStyle = ROAD;
    for (const [width, path] of this.surface) { context.lineWidth = width + 0.3; context.stroke(path); }
    context.fillStyle = "#e9e6e0"; context.fill(this.areas);
    context.strokeStyle = MARK; context.lineWidth = 0.9 * px; context.stroke(this.areas); context.stroke(this.marks);
    context.strokeStyle = LANE; context.lineWidth = Math.min(0.9 * px, 0.25); context.stroke(this.lanes);
    if (scale > 2.5) { context.strokeStyle = "#aeb4bc"; context.lineWidth = px; context.stroke(this.arrows); }
    context.strokeStyle = EDGE; context.lineWidth = Math.max(1.3 * px, 0.12); context.stroke(this.edges);
    for (const [x, y] of this.signs) {
      context.beginPath(); context.arc(x, y, Math.max(4 * px, 0.5), 0, 7);
      context.fillStyle = "white"; context.fill(); context.strokeStyle = STOP; context.lineWidth = 2 * px; context.stroke();
    }
    if (above) above(context);
    context.setTransform(1, 0, 0, 1, 0, 0);
  }
}

// Which part of the world is seen: x and y of its centre in metres, pixels per metre.
class Camera {
  constructor() { this.x = 0; this.y = 0; this.scale = 4; this.width = 1; this.height = 1; this.ratio = 1; }
  toScreen(x, y) { return [this.width / 2 + (x - this.x) * this.scale, this.height / 2 - (y - this.y) * this.scale]; }
  toWorld(px, py) { return [this.x + (px - this.width / 2) / this.scale, this.y - (py - this.height / 2) / this.scale]; }
  zoom(factor, px, py) {
    const [x, y] = this.toWorld(px, py);
    this.scale = Math.min(120, Math.max(0.15, this.scale * factor));
    this.x = x - (px - this.width / 2) / this.scale;
    this.y = y + (py - this.height / 2) / this.scale;
  }
  fit(box) {
    const [x0, x1, y0, y1] = box;
    this.x = (x0 + x1) / 2; this.y = (y0 + y1) / 2;
    this.scale = Math.min(30, this.width / Math.max(x1 - x0, 40), this.height / Math.max(y1 - y0, 40));
  }
}
