// The chromaticity plane: illuminants of a LUT, their gamut, and the selected illuminant.

const $ = (id) => document.getElementById(id);

/** Return an HTML element with attributes and children; strings become text nodes. */
function element(name, attributes = {}, ...children) {
  const node = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
  node.append(...children);
  return node;
}

/** Return an SVG element. */
function shape(name, attributes = {}, ...children) {
  const node = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
  node.append(...children);
  return node;
}

/** Return a chromaticity or weight as text. */
const short = (number) => number.toFixed(3);

/** Largest movement of a pointer that is a click, and largest distance from an illuminant, px; suits a finger. */
const STEADY_PX = 5;
const NEAR = 12;
/** Number of illuminants above which small marks are drawn, because large ones would overlap. */
const MANY = 60;
/** Step of the arrow keys, about 0.1 degrees; ten steps with Shift. */
const STEP = 0.001;

class Plane {
  /** Callbacks get: `onPick` the number of an illuminant, `onStep` a number of steps, `onMove` a chromaticity [r, b]. */
  constructor(box, table, onPick, onStep, onMove) {
    const points = table.lights.map((light) => light.rb);
    const [low, high] = [0, 1].map((axis) => [Math.min, Math.max].map((extreme) => extreme(...points.map((rb) => rb[axis]))));
    this.span = Math.max(low[1] - low[0], high[1] - high[0], 0.02) * 1.3;
    this.origin = [low, high].map(([start, end]) => (start + end) / 2 - this.span / 2);
    this.lights = points;
    this.chosen = points[0];
    this.svg = shape("svg", { viewBox: `0 0 ${Plane.SIDE + 44} ${Plane.SIDE + 40}`, "aria-hidden": "true" });
    this.drawGrid();
    const path = (points) => points.map((rb, index) => `${index ? "L" : "M"}${this.place(rb).join(" ")}`).join("");
    this.svg.append(
      shape("path", { class: "gamut", d: `${path(table.hull)}Z` }),
    );
    this.line = shape("path", { class: "mixing" });
    this.svg.append(this.line);
    const many = table.lights.length > MANY;
    const radius = many ? 2.5 : 5;
    this.svg.classList.toggle("many", many);
    table.lights.forEach(({ label, codes, rb }, number) => {
      const [cx, cy] = this.place(rb);
      const title = shape("title", {}, `illuminant ${number}: ${label}`);
      this.svg.append(shape("circle", { class: "light", cx, cy, r: radius, fill: `rgb(${codes.join(",")})` }, title));
    });
    const curve = path(table.black_bodies.map(([, r, b]) => [r, b]));
    this.svg.append(...["bodies halo", "bodies"].map((name) => shape("path", { class: name, d: curve })));
    this.rings = ["chosen halo", "chosen"].map((name) => shape("circle", { class: name, r: 9, cx: -99 }));
    this.svg.append(...this.rings);
    box.append(this.svg);
    this.listen(box, onPick, onStep, onMove);
  }

  place([r, b]) {
    const [x, y] = [r, b].map((value, axis) => ((value - this.origin[axis]) / this.span) * Plane.SIDE);
    return [40 + x, 6 + Plane.SIDE - y];
  }

  drawGrid() {
    const step = [0.01, 0.02, 0.05, 0.1, 0.2].find((candidate) => this.span / candidate < 7) ?? 0.5;
    const [left, bottom] = [40, 6 + Plane.SIDE];
    for (const axis of [0, 1]) {
      const first = Math.ceil(this.origin[axis] / step);
      for (let tick = first; tick * step < this.origin[axis] + this.span; tick++) {
        const rb = [...this.origin];
        rb[axis] = tick * step;
        const [x, y] = this.place(rb);
        const line = axis ? { x1: left, x2: left + Plane.SIDE, y1: y, y2: y } : { x1: x, x2: x, y1: 6, y2: bottom };
        const at = axis ? { x: left - 5, y: y + 4, "text-anchor": "end" } : { x, y: bottom + 15, "text-anchor": "middle" };
        this.svg.append(shape("line", { class: "gridline", ...line }));
        this.svg.append(shape("text", at, (tick * step).toFixed(2)));
      }
    }
    this.svg.append(
      shape("text", { x: left + Plane.SIDE / 2, y: bottom + 30, "text-anchor": "middle" }, "r = R / (R + G + B)"),
      shape("text", { x: 4, y: 16 }, "b"),
    );
  }

  listen(box, onPick, onStep, onMove) {
    let down = null;
    const at = (event) => new DOMPoint(event.clientX, event.clientY).matrixTransform(this.svg.getScreenCTM().inverse());
    const move = (event) => {
      const { x, y } = at(event);
      const offset = [x - 40, 6 + Plane.SIDE - y];
      onMove(this.within(offset.map((value, axis) => this.origin[axis] + (value / Plane.SIDE) * this.span)));
    };
    box.addEventListener("pointerdown", (event) => {
      if (event.button) return;
      box.setPointerCapture(event.pointerId);
      down = [event.clientX, event.clientY];
    });
    box.addEventListener("pointermove", (event) => {
      if (down && Math.hypot(event.clientX - down[0], event.clientY - down[1]) > STEADY_PX) down = [Infinity, 0];
      if (down && down[0] === Infinity) move(event);
    });
    box.addEventListener("pointerup", (event) => {
      const light = down && down[0] !== Infinity ? this.nearest(at(event)) : null;
      if (light !== null) onPick(light);
      else if (down) move(event);
      down = null;
    });
    box.addEventListener("pointercancel", () => (down = null));
    box.addEventListener("keydown", (event) => {
      const direction = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowDown: [0, -1], ArrowUp: [0, 1] }[event.key];
      const page = { PageUp: -1, PageDown: 1 }[event.key];
      if (!direction && !page) return;
      event.preventDefault();
      const step = STEP * (event.shiftKey ? 10 : 1);
      if (direction) onMove(this.within(this.chosen.map((value, axis) => value + step * direction[axis])));
      else onStep(page);
    });
  }

  /** Return the chromaticity moved into the triangle r, b ≥ 0, r + b ≤ 1. */
  within([r, b]) {
    const [red, blue] = [r, b].map((value) => Math.min(Math.max(value, 0), 1));
    const sum = Math.max(red + blue, 1);
    return [red / sum, blue / sum];
  }

  nearest({ x, y }) {
    let [nearest, smallest] = [null, NEAR];
    this.lights.forEach((rb, number) => {
      const [px, py] = this.place(rb);
      const distance = Math.hypot(px - x, py - y);
      if (distance < smallest) [nearest, smallest] = [number, distance];
    });
    return nearest;
  }

  /** Mark the selected illuminant, and lines to the illuminants of its mixture. */
  choose(rb, parts) {
    this.chosen = rb;
    const [cx, cy] = this.place(rb);
    for (const ring of this.rings) {
      ring.setAttribute("cx", cx);
      ring.setAttribute("cy", cy);
    }
    const lines = parts.map(([light]) => `M${cx} ${cy}L${this.place(this.lights[light]).join(" ")}`);
    this.line.setAttribute("d", lines.join(""));
  }
}
Plane.SIDE = 300;
