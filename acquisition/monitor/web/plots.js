"use strict";
// Plots and elements, made from data and never from markup, so that no text of a session can become code.

const SVG = "http://www.w3.org/2000/svg";

/** Return an element; attributes by name, children are elements or text. */
function element(name, attributes = {}, ...children) {
  return filled(document.createElement(name), attributes, children);
}

/** Return an SVG element; arguments as for `element`. */
function shape(name, attributes = {}, ...children) {
  return filled(document.createElementNS(SVG, name), attributes, children);
}

function filled(made, attributes, children) {
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  made.append(...children);
  return made;
}

/** Return a number with three significant digits. */
function short(value) {
  if (value === null || value === undefined) return "–";
  if (value === 0) return "0";
  const size = Math.abs(value);
  if (size >= 100) return value.toFixed(0);
  if (size >= 10) return value.toFixed(1);
  return size >= 0.0005 ? String(Number(value.toPrecision(size >= 0.01 ? 3 : 2))) : value.toExponential(1);
}

/** Return a number with enough decimals for a range of `span`. */
function within(value, span) {
  const decimals = Math.max(0, Math.min(6, 2 - Math.floor(Math.log10(span))));
  return decimals > 4 ? short(value) : value.toFixed(decimals).replace(/^-(0\.?0*)$/, "$1");
}

/** Return a value as text with its unit. */
const withUnit = (value, unit) => (unit ? `${short(value)} ${unit}` : short(value));

/** Return the limits of a check as text. */
function limitText(low, high, unit) {
  if (low !== null && high !== null) return `${short(low)} … ${withUnit(high, unit)}`;
  if (high !== null) return `≤ ${withUnit(high, unit)}`;
  return low !== null ? `≥ ${withUnit(low, unit)}` : "";
}

/** Return the path of a mark of radius `size` around x, y: the form shows the state, too, not the colour alone. */
function markPath(kind, x, y, size) {
  if (kind === "cross")
    return `M${x - size} ${y - size}L${x + size} ${y + size}M${x - size} ${y + size}L${x + size} ${y - size}`;
  if (kind === "diamond") return `M${x} ${y - size}L${x + size} ${y}L${x} ${y + size}L${x - size} ${y}Z`;
  return `M${x - size} ${y}a${size} ${size} 0 1 0 ${2 * size} 0a${size} ${size} 0 1 0 ${-2 * size} 0Z`;
}

/** The plane of rb chromaticities: a mark for each illuminant, their triangle, a ring around the chosen one. */
class Plane {
  constructor(box, label, onChoose) {
    this.marks = new Map();
    this.places = new Map();
    this.box = box;
    const side = Plane.SIDE;
    this.svg = shape("svg", { viewBox: `0 0 ${side + 44} ${side + 40}`, role: "img", "aria-label": label });
    const [ox, oy] = Plane.place(0, 0);
    const [rx, ry] = Plane.place(1, 0);
    const [bx, by] = Plane.place(0, 1);
    for (const tick of [0, 0.2, 0.4, 0.6, 0.8, 1]) {
      const [x, y] = Plane.place(tick, tick);
      const end = Plane.place(1 - tick, tick);
      this.svg.append(
        shape("line", { class: "gridline", x1: ox, y1: y, x2: end[0], y2: y }),
        shape("line", { class: "gridline", x1: x, y1: oy, x2: x, y2: Plane.place(tick, 1 - tick)[1] }),
        shape("text", { x, y: oy + 14, "text-anchor": "middle" }, String(tick)),
        shape("text", { x: ox - 6, y: y + 4, "text-anchor": "end" }, String(tick)),
      );
    }
    this.svg.append(
      shape("path", { class: "outline", d: `M${ox} ${oy}L${rx} ${ry}L${bx} ${by}Z` }),
      shape("text", { x: (ox + rx) / 2, y: oy + 29, "text-anchor": "middle" }, "r"),
      shape("text", { x: 10, y: (oy + by) / 2, "text-anchor": "middle" }, "b"),
    );
    this.reach = shape("path", { class: "outline" });
    this.layer = shape("g");
    this.ring = shape("path", { class: "chosen" });
    this.svg.append(this.reach, this.layer, this.ring);
    box.append(this.svg);
    this.svg.addEventListener("click", (event) => {
      const nearest = this.nearest(event);
      if (nearest !== null) onChoose(nearest);
    });
  }

  static place(r, b) {
    return [34 + r * Plane.SIDE, 8 + (1 - b) * Plane.SIDE];
  }

  /** Draw the mark of an illuminant at [r, b]; null removes it. */
  mark(light, at, { form, state, fill, title }) {
    let mark = this.marks.get(light);
    if (at === null) {
      if (mark) mark.remove();
      this.marks.delete(light);
      this.places.delete(light);
      return;
    }
    if (!mark) {
      mark = shape("path", {}, shape("title"));
      this.marks.set(light, mark);
    }
    // New marks are on top.
    this.layer.append(mark);
    const [x, y] = Plane.place(...at);
    this.places.set(light, [x, y]);
    const size = state === "planned" ? 2.6 : form === "diamond" ? 4.4 : 3.6;
    mark.setAttribute("class", `mark ${state}`);
    mark.setAttribute("d", markPath(state === "refused" ? "cross" : form, x, y, size));
    if (state === "accepted" || state === "shown") mark.setAttribute("fill", fill);
    else mark.removeAttribute("fill");
    mark.firstChild.textContent = title;
  }

  /** Draw the triangle between three chromaticities: the range of their mixtures. */
  drawReach(places) {
    this.reach.setAttribute("d", `${pathThrough(places.map((at) => Plane.place(...at)))}Z`);
  }

  choose(light) {
    const place = this.places.get(light);
    this.ring.setAttribute("d", place ? markPath("circle", place[0], place[1], 8) : "");
  }

  nearest(event) {
    const point = new DOMPoint(event.clientX, event.clientY).matrixTransform(this.svg.getScreenCTM().inverse());
    let [nearest, least] = [null, 20 ** 2];
    for (const [light, [x, y]] of this.places) {
      const distance = (x - point.x) ** 2 + (y - point.y) ** 2;
      if (distance < least) [nearest, least] = [light, distance];
    }
    return nearest;
  }
}
Plane.SIDE = 300;

const PLOT = { width: 340, height: 96, left: 42, right: 4, top: 5, bottom: 14 };

/** Return the x coordinate of attempt `index` of `count` in a plot. */
function across(index, count, plot = PLOT) {
  return plot.left + (count > 1 ? index / (count - 1) : 0.5) * (plot.width - plot.left - plot.right);
}

/** Return a path through points; null interrupts it. */
function pathThrough(points) {
  let path = "";
  let down = false;
  for (const point of points) {
    if (point === null) down = false;
    else {
      path += `${down ? "L" : "M"}${point[0].toFixed(1)} ${point[1].toFixed(1)}`;
      down = true;
    }
  }
  return path;
}

/** Return the value below which a share of sorted values lies. */
const quantile = (sorted, share) => sorted[Math.round(share * (sorted.length - 1))];

/**
 * Return the range of a plot, at least `least` wide.
 *
 * It includes most limits, so that drifts towards them are visible. Values far beyond, and limits far from nearly all
 * others (dim illuminants), are drawn at the edge, so that a few frames do not flatten the rest.
 */
function rangeOf(values, limits, least) {
  const [sorted, bounds] = [values, limits].map((numbers) => [...numbers].sort((a, b) => a - b));
  const [first, last] = [sorted[0], sorted[sorted.length - 1]];
  const within = bounds.length ? [quantile(bounds, 0.1), quantile(bounds, 0.9)] : [];
  let low = Math.min(quantile(sorted, 0.05), ...within);
  let high = Math.max(quantile(sorted, 0.95), ...within);
  const reach = Math.max((high - low) * (limits.length ? 0.6 : 2), Math.abs(high) * 0.02);
  [low, high] = [Math.min(low, Math.max(first, low - reach)), Math.max(high, Math.min(last, high + reach))];
  const margin = Math.max((high - low) * 0.08, (least - (high - low)) / 2) || Math.abs(high) * 0.05 || 1;
  return [low < 0 ? low - margin : Math.max(0, low - margin), high + margin];
}

// Values that vary by less than this share of the height of their plot count as equal.
const FLAT = 0.02;

/**
 * Return a plot of one quantity over the attempts.
 *
 * Points are {index, value, good, low, high, curve}: `low` and `high` are limits or null, `curve` the number of the
 * line that joins them, 0 … 2.
 */
function plotOf({ name, explanation, unit, points, count, least }) {
  const limits = points.flatMap((point) => [point.low, point.high].filter((limit) => limit !== null));
  const [low, high] = rangeOf(
    points.map((point) => point.value),
    limits,
    least,
  );
  const bottom = PLOT.height - PLOT.bottom;
  const y = (value) => bottom - ((value - low) / (high - low)) * (bottom - PLOT.top);
  const clamped = (value) => Math.max(PLOT.top, Math.min(bottom, y(value)));
  const at = (point) => [across(point.index, count), clamped(point.value)];
  const bad = points.filter((point) => !point.good);
  const latest = [0, 1, 2].map((curve) => points.findLast((point) => point.curve === curve)).filter(Boolean);
  const values = `${latest.map((point) => within(point.value, high - low)).join(", ")} ${unit ?? ""}`.trim();
  const allowed = limitText(latest[0].low, latest[0].high, unit);
  const label = `${name}: latest ${values}${allowed ? `, allowed ${allowed}` : ""}; ${bad.length} refused`;
  const svg = shape("svg", { viewBox: `0 0 ${PLOT.width} ${PLOT.height}`, role: "img", "aria-label": label });
  svg.append(
    shape("line", { class: "axis", x1: PLOT.left, x2: PLOT.width - PLOT.right, y1: bottom, y2: bottom }),
    shape("text", { x: PLOT.left - 5, y: PLOT.top + 8, "text-anchor": "end" }, short(high)),
    shape("text", { x: PLOT.left - 5, y: bottom, "text-anchor": "end" }, short(low)),
  );
  for (const side of ["low", "high"]) {
    const line = points.map((point) => (point[side] === null ? null : [across(point.index, count), clamped(point[side])]));
    const alone = line.length === 1 && line[0];
    const path = alone ? `M${PLOT.left} ${alone[1]}H${PLOT.width - PLOT.right}` : pathThrough(line);
    if (path) svg.append(shape("path", { class: "limit", d: path }));
  }
  for (const curve of [0, 1, 2]) {
    const places = points.filter((point) => point.good && point.curve === curve).map(at);
    if (!places.length) continue;
    svg.append(shape("path", { class: `curve curve-${curve}`, d: pathThrough(places) }));
    if (places.length < 90)
      svg.append(shape("path", { class: "dots", d: places.map(([px, py]) => `M${px} ${py}h0`).join("") }));
  }
  const beyond = points.filter((point) => point.good && (point.value > high || point.value < low)).map(at);
  svg.append(
    shape("path", { class: "beyond", d: beyond.map(([px, py]) => markPath("diamond", px, py, 3)).join("") }),
    shape("path", {
      class: "out",
      d: bad
        .map(at)
        .map(([px, py]) => markPath("cross", px, py, 3))
        .join(""),
    }),
  );
  const cursor = shape("line", { class: "cursor", y1: PLOT.top, y2: bottom, visibility: "hidden" });
  svg.append(cursor);
  const head = element(
    "div",
    { class: "plot-head", title: explanation },
    element("b", {}, name),
    element("span", {}, [values, allowed].filter(Boolean).join(", ")),
  );
  svg.prepend(shape("title", {}, explanation));
  const numbers = points.map((point) => point.value);
  const isFlat = !bad.length && Math.max(...numbers) - Math.min(...numbers) <= FLAT * (high - low);
  return { box: element("div", { class: "plot" }, head, svg), cursor, isFlat };
}

const STRIP = { width: 1000, height: 34, left: 2, right: 2 };

/** Return a strip with a tick for each attempt; height and colour show the verdict. */
function stripOf(frames) {
  const svg = shape("svg", { viewBox: `0 0 ${STRIP.width} ${STRIP.height}`, role: "img", preserveAspectRatio: "none" });
  const tops = { accepted: 16, refused: 0, voided: 8, failed: 24, open: 16 };
  const paths = {};
  frames.forEach((frame, index) => {
    const kind = frame.verdict || "open";
    paths[kind] = `${paths[kind] ?? ""}M${across(index, frames.length, STRIP).toFixed(1)} 34V${tops[kind] ?? 0}`;
  });
  const width = Math.max(1, Math.min(8, (STRIP.width / Math.max(1, frames.length)) * 0.7));
  for (const [kind, path] of Object.entries(paths))
    svg.append(shape("path", { class: `tick-${kind}`, d: path, "stroke-width": width }));
  const cursor = shape("line", { class: "cursor", y1: 0, y2: STRIP.height, visibility: "hidden" });
  svg.append(cursor);
  return { svg, cursor };
}
