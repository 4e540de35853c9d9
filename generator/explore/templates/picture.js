// The panel of one rendering: requests the counts of a picture, and draws image, pixel and histogram.

/** Parameters of the tone mapping operator Flash, as for the previews of data sets. */
const STRENGTH = 5;
const GAMMA = 2.2;
const DARK = 1e-9;
const BINS = 96;
const LOUPE = 11;

/** Request an answer of the program; throws an Error with its message. */
async function ask(address, options) {
  let answer;
  try {
    answer = await fetch(address, options);
  } catch {
    throw new Error("The program does not answer; check that generate explore is running.");
  }
  if (!answer.ok) throw new Error((await answer.text()).trim());
  return answer;
}

/** Return a function that runs `job` with the newest arguments; calls during a run are replaced by later ones. */
function newest(job) {
  let waiting = null;
  let busy = false;
  return async (...args) => {
    waiting = args;
    if (busy) return;
    busy = true;
    try {
      while (waiting) {
        const current = waiting;
        waiting = null;
        await job(...current);
      }
    } finally {
      busy = false;
    }
  };
}

/**
 * Fill `out` (RGBA bytes) with tone mapped counts (RGB); `most` is the largest count.
 *
 * Red, green and blue are multiplied by `gains`; `white` is the saturation level. Source: N. Banić, S. Lončarić, "Flash
 * and Storm: fast and highly practical tone mapping based on Naka-Rushton equation", VISAPP 2018.
 */
function toneMap(counts, most, white, gains, out) {
  const scaled = gains.map((gain) => Float32Array.from({ length: most + 1 }, (_, count) => count * gain));
  const roots = scaled.map((values) => values.map((value) => (value / white) ** (1 / GAMMA)));
  const [red, green, blue] = scaled;
  // Brightness is rounded to counts, or to 1/65535 of the largest value if a channel has a large gain.
  const brightest = Math.min(65535, Math.ceil(most * Math.max(...gains)));
  const unit = Math.max(1, (most * Math.max(...gains)) / 65535);
  const histogram = new Uint32Array(brightest + 1);
  const brightness = new Uint16Array(counts.length / 3);
  for (let at = 0, pixel = 0; at < counts.length; at += 3, pixel++) {
    brightness[pixel] = Math.max(red[counts[at]], green[counts[at + 1]], blue[counts[at + 2]]) / unit;
    histogram[brightness[pixel]]++;
  }
  let [sum, peak] = [0, DARK];
  histogram.forEach((pixels, level) => {
    if (!pixels) return;
    peak = Math.max((level * unit) / white, DARK);
    sum += pixels * Math.log(peak);
  });
  const k = STRENGTH * Math.exp(sum / brightness.length);
  const scale = 255 / (peak / (peak + k)) ** (1 / GAMMA);
  const shades = Float32Array.from({ length: brightest + 1 }, (_, level) => {
    return scale * (Math.max((level * unit) / white, DARK) + k) ** (-1 / GAMMA);
  });
  for (let at = 0, pixel = 0, to = 0; at < counts.length; at += 3, pixel++, to += 4) {
    const shade = shades[brightness[pixel]];
    out[to] = roots[0][counts[at]] * shade;
    out[to + 1] = roots[1][counts[at + 1]] * shade;
    out[to + 2] = roots[2][counts[at + 2]] * shade;
    out[to + 3] = 255;
  }
}

/** Fill `out` (RGBA bytes) with linear counts; the count `white` is white. */
function showCounts(counts, white, out) {
  for (let at = 0, to = 0; at < counts.length; at += 3, to += 4) {
    out[to] = (255 * counts[at]) / white;
    out[to + 1] = (255 * counts[at + 1]) / white;
    out[to + 2] = (255 * counts[at + 2]) / white;
    out[to + 3] = 255;
  }
}

class Panel {
  /** `onPoint` is called with the selected pixel [x, y]. */
  constructor(rendering, title, white, onPoint) {
    [this.rendering, this.title, this.white] = [rendering, title, white];
    // Counts and the noise of the selected pixel; either may arrive first.
    this.counts = null;
    this.drawn = "";
    this.most = 0;
    this.at = null;
    this.noise = null;
    this.canvas = element("canvas", { role: "img", "aria-label": title });
    this.mark = element("span", { class: "mark", hidden: "" });
    this.screen = element("div", { class: "screen", tabindex: "0", role: "group", hidden: "" }, this.canvas, this.mark);
    this.screen.setAttribute("aria-label", `${title}; arrow keys move the selected pixel`);
    this.wait = element("p", { class: "wait" }, "…");
    $("panels").append(element("div", {}, element("h3", {}, title), this.screen, this.wait));
    this.loupe = element("canvas", { width: 132, height: 132, role: "img", "aria-label": `Enlarged pixels, ${title}` });
    this.rows = element("tbody");
    const heads = ["", "counts", "mean ± sd"].map((text) => element("th", { scope: "col" }, text));
    const table = element("table", {}, element("thead", {}, element("tr", {}, ...heads)), this.rows);
    $("loupes").append(
      element("div", {}, element("h3", {}, title), element("div", { class: "loupe" }, this.loupe, table)),
    );
    this.histogram = element("div", { class: "histogram" });
    $("histograms").append(element("div", {}, element("h3", {}, title), this.histogram));
    this.show = newest((picture, light, display) => this.fetchImage(picture, light, display));
    this.measure = newest((picture, light, at) => this.fetchNoise(picture, light, at));
    this.listen(onPoint);
  }

  listen(onPoint) {
    const point = (event) => {
      const box = this.canvas.getBoundingClientRect();
      const { width, height } = this.canvas;
      const position = [((event.clientX - box.left) / box.width) * width, ((event.clientY - box.top) / box.height) * height];
      onPoint(position.map(Math.floor));
    };
    let down = false;
    this.screen.addEventListener("pointerdown", (event) => {
      if (event.button) return;
      down = true;
      this.screen.setPointerCapture(event.pointerId);
      point(event);
    });
    this.screen.addEventListener("pointermove", (event) => down && point(event));
    for (const end of ["pointerup", "pointercancel"]) this.screen.addEventListener(end, () => (down = false));
    this.screen.addEventListener("keydown", (event) => {
      const direction = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowDown: [0, 1], ArrowUp: [0, -1] }[event.key];
      if (!direction) return;
      event.preventDefault();
      onPoint(direction.map((step) => step * (event.shiftKey ? 10 : 1)), true);
    });
  }

  async fetchImage(picture, light, display) {
    const timer = setTimeout(() => this.message(this.counts ? "…" : "… (the first picture by colour takes a few seconds)"), 400);
    try {
      const answer = await ask(`counts?${new URLSearchParams({ picture, light, rendering: this.rendering })}`);
      const data = await answer.arrayBuffer();
      const [height, width] = new Uint32Array(data, 0, 2);
      this.counts = new Uint16Array(data, 8);
      this.drawn = `${picture} ${light}`;
      this.most = 0;
      for (let at = 0; at < this.counts.length; at++) if (this.counts[at] > this.most) this.most = this.counts[at];
      [this.canvas.width, this.canvas.height] = [width, height];
      this.message("");
      this.draw(display());
      this.drawHistogram();
    } catch (error) {
      this.counts = null;
      this.message(error.message, true);
    } finally {
      clearTimeout(timer);
    }
  }

  message(text, bad = false) {
    this.wait.textContent = text;
    this.wait.classList.toggle("bad", bad);
    this.wait.hidden = !text;
    this.screen.hidden = !this.counts || bad;
  }

  /** Draw the image in a `view`; `truth` is the ground truth, `at` the selected pixel or null. */
  draw({ view, truth, at }) {
    if (!this.counts) return;
    const context = this.canvas.getContext("2d");
    const image = context.createImageData(this.canvas.width, this.canvas.height);
    const gains = view === "balanced" ? truth.map((channel) => truth[1] / channel) : [1, 1, 1];
    if (view === "counts") showCounts(this.counts, this.white, image.data);
    else toneMap(this.counts, this.most, this.white, gains, image.data);
    context.putImageData(image, 0, 0);
    this.point(at);
  }

  drawHistogram() {
    const [width, height] = [320, 110];
    const bins = [0, 1, 2].map(() => new Uint32Array(BINS + 1));
    const [counts, scale] = [this.counts, BINS / this.white];
    for (let at = 0; at < counts.length; at += 3) {
      bins[0][(counts[at] * scale) | 0]++;
      bins[1][(counts[at + 1] * scale) | 0]++;
      bins[2][(counts[at + 2] * scale) | 0]++;
    }
    const tallest = Math.log1p(Math.max(...bins.flatMap((channel) => [...channel])));
    const x = (bin) => 4 + (bin / BINS) * (width - 8);
    const svg = shape("svg", { viewBox: `0 0 ${width} ${height + 18}`, role: "img" });
    svg.setAttribute("aria-label", `Histogram, ${this.title}: counts up to ${this.most} of ${this.white}`);
    svg.append(shape("line", { class: "gridline", x1: 4, x2: width - 4, y1: height, y2: height }));
    svg.append(shape("line", { class: "saturation", x1: x(BINS), x2: x(BINS), y1: 6, y2: height }));
    ["red", "green", "blue"].forEach((name, channel) => {
      const points = [...bins[channel]].map((pixels, bin) => {
        return `${x(Math.min(bin + 0.5, BINS)).toFixed(1)} ${(height - (Math.log1p(pixels) / tallest) * (height - 8)).toFixed(1)}`;
      });
      svg.append(shape("path", { class: name, d: `M${points.join("L")}` }));
    });
    svg.append(
      shape("text", { x: 4, y: height + 14 }, "0"),
      shape("text", { x: width - 4, y: height + 14, "text-anchor": "end" }, String(this.white)),
      shape("text", { x: width / 2, y: height + 14, "text-anchor": "middle" }, `largest ${this.most}`),
    );
    this.histogram.replaceChildren(svg);
  }

  /** Select a pixel [x, y], or none with null. */
  point(at) {
    const { width, height } = this.canvas;
    const isInside = this.counts && at && at[0] < width && at[1] < height;
    this.at = isInside ? at : null;
    this.mark.hidden = !isInside;
    this.drawRows();
    if (!isInside) return;
    this.mark.style.left = `${(100 * (at[0] + 0.5)) / width}%`;
    this.mark.style.top = `${(100 * (at[1] + 0.5)) / height}%`;
    const [side, half] = [this.loupe.width, (LOUPE - 1) / 2];
    const context = this.loupe.getContext("2d");
    context.imageSmoothingEnabled = false;
    context.fillRect(0, 0, side, side);
    context.drawImage(this.canvas, at[0] - half, at[1] - half, LOUPE, LOUPE, 0, 0, side, side);
    for (const [colour, wide] of [["#000", 4], ["#fff", 2]]) {
      [context.strokeStyle, context.lineWidth] = [colour, wide];
      context.strokeRect((half * side) / LOUPE, (half * side) / LOUPE, side / LOUPE, side / LOUPE);
    }
  }

  async fetchNoise(picture, light, at) {
    const query = new URLSearchParams({ picture, light, rendering: this.rendering, x: at[0], y: at[1] });
    try {
      const answer = await (await ask(`pixel.json?${query}`)).json();
      this.noise = { ...answer, of: `${picture} ${light} ${at}` };
    } catch {
      // The panel already shows the error of the rendering.
      this.noise = null;
    }
    this.drawRows();
  }

  /** Show the counts of the selected pixel, and its noise if it is for the same picture and illuminant. */
  drawRows() {
    const { at } = this;
    const first = at && 3 * (at[1] * this.canvas.width + at[0]);
    const noise = this.noise?.of === `${this.drawn} ${at}` ? this.noise : null;
    const rows = ["R", "G", "B"].map((name, channel) => {
      const count = this.counts && at ? String(this.counts[first + channel]) : "";
      const spread = noise ? `${noise.mean[channel].toFixed(1)} ± ${noise.deviation[channel].toFixed(1)}` : "";
      const cells = [count, spread].map((text) => element("td", {}, text));
      return element("tr", {}, element("th", { scope: "row" }, name), ...cells);
    });
    this.rows.replaceChildren(...rows);
  }
}
