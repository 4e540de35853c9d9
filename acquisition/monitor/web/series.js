// Measured values of all frames, refused frames, and events. Called from page.js, whose model it shows.

function seriesOf(frames) {
  const series = new Map();
  const add = (name, unit, point, least = 0) => {
    if (point.value === null || point.value === undefined) return;
    // One check may have two units: degrees for an illuminant, percent for a primary.
    const key = `${name} ${unit}`;
    if (!series.has(key)) series.set(key, { name, unit, least, points: [] });
    series.get(key).points.push({ low: null, high: null, good: true, curve: 0, ...point });
  };
  let white = null;
  frames.forEach((frame, index) => {
    const kind = stepOf(frame)?.kind;
    if (kind === "white" && frame.seen && frame.verdict === "accepted") {
      white ??= frame.seen;
      frame.seen.forEach((value, curve) =>
        add(WHITE, "% of first", { index, value: (100 * value) / white[curve], curve }, 1),
      );
    }
    if (kind === "dark" && frame.seen)
      frame.seen.forEach((value, curve) => add(BLACK, "DN", { index, value, curve }, 2));
    for (const [name, unit, value, low, high, reason] of frame.checks ?? []) {
      add(name, unit, { index, value, low, high, good: !reason });
    }
    add(PACE, "s", { index, value: frame.seconds }, 0.5);
  });
  const rank = (name) => (PLOT_ORDER.includes(name) ? PLOT_ORDER.indexOf(name) : PLOT_ORDER.length);
  const names = [...series.values()].map((one) => one.name);
  const isDouble = (name) => names.indexOf(name) !== names.lastIndexOf(name);
  for (const one of series.values()) {
    one.explanation = explanationOf(one.name);
    one.label = `${titleOf(one.name)}${isDouble(one.name) ? `, ${one.unit || "number"}` : ""}`;
  }
  return [...series.values()].sort((one, other) => rank(one.name) - rank(other.name));
}

let flatOpen = false;

function drawSeries(frames) {
  const count = frames.length;
  const refusals = frames.filter((frame) => frame.verdict && frame.verdict !== "accepted").length;
  $("series-note").textContent =
    `${count} attempts in the order of taking, ${refusals} of them not accepted. ` +
    "Dashed lines are limits, crosses are frames refused by the check.";
  drawn.strip = stripOf(frames);
  drawn.strip.svg.setAttribute("aria-label", `Verdicts of ${count} attempts`);
  $("verdicts").replaceChildren(drawn.strip.svg);
  drawn.plots = seriesOf(frames).map((one) => plotOf({ ...one, name: one.label, count }));
  const boxes = (isFlat) => drawn.plots.filter((plot) => plot.isFlat === isFlat).map((plot) => plot.box);
  const flat = boxes(true);
  $("series").replaceChildren(...boxes(false));
  if (!flat.length) return;
  const fold = element("details", { class: "flat" }, element("summary", {}, `Without change (${flat.length})`), element("div", {}, ...flat));
  fold.open = flatOpen;
  fold.addEventListener("toggle", () => (flatOpen = fold.open));
  $("series").append(fold);
}

function chooseAt(event, plot) {
  const svg = event.target.closest("svg");
  const frames = inOrder();
  if (!svg || !frames.length) return;
  const x = new DOMPoint(event.clientX, event.clientY).matrixTransform(svg.getScreenCTM().inverse()).x;
  const share = (x - plot.left) / (plot.width - plot.left - plot.right);
  const index = Math.max(0, Math.min(frames.length - 1, Math.round(share * (frames.length - 1))));
  choose(frames[index].id, frames);
}

// Refusals and events ----------------------------------------------------------------------------------------------

function drawRefused(frames) {
  const bad = frames.filter((frame) => ["refused", "voided", "failed"].includes(frame.verdict)).reverse();
  const shown = allRefused ? bad : bad.slice(0, REFUSED_SHOWN);
  const again = new Set(frames.filter((frame) => frame.verdict === "accepted").map((frame) => frame.step));
  const key = JSON.stringify([
    allRefused,
    bad.map((frame) => [frame.id, frame.verdict, frame.preview, again.has(frame.step)]),
  ]);
  if (drawn.refused === key) return; // Unchanged content keeps scroll position and focus.
  drawn.refused = key;
  $("refused-title").textContent = bad.length ? `Refused frames (${bad.length})` : "Refused frames";
  $("more").hidden = bad.length <= REFUSED_SHOWN;
  $("more").textContent = allRefused ? "Show the newest" : `Show all ${bad.length}`;
  if (!bad.length) {
    $("refused").replaceChildren(element("p", { class: "note" }, "None."));
    return;
  }
  $("refused").replaceChildren(...shown.map((frame) => refusalOf(frame, again.has(frame.step))));
}

function refusalOf(frame, mended) {
  const name = nameOf(stepOf(frame));
  const button = element("button", { type: "button", class: "name" }, `${name}: ${frame.verdict}`);
  button.addEventListener("click", () => {
    choose(frame.id);
    $("frame-title").focus();
  });
  const parts = [button];
  const source = pictureOf(frame);
  // A report may be printed, and needs all pictures; a live page loads only visible ones.
  const loading = embedded ? "eager" : "lazy";
  if (source) parts.push(element("img", { src: source, alt: `${name}, ${frame.verdict}`, loading }));
  parts.push(element("p", {}, frame.reason || "no reason recorded"));
  parts.push(
    element(
      "p",
      { class: "note" },
      `${dayText(frame.taken ?? frame.at)}; ${mended ? "repeated and accepted" : "not repeated yet"}`,
    ),
  );
  return element("article", { class: "refusal" }, ...parts);
}

function drawEvents() {
  $("events").replaceChildren(
    ...[...model.events]
      .reverse()
      .map(([at, what, detail]) =>
        element(
          "tr",
          {},
          element("td", { class: "number" }, dayText(at)),
          element("th", { scope: "row" }, what),
          element("td", {}, detail),
        ),
      ),
  );
}
