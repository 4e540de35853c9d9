// The page of a session. A live page fetches the state from state.json; a report has it embedded.

// A frame takes at least 2 s; a hidden page may be updated later.
const POLL_MS = 2000;
const POLL_HIDDEN_MS = 10000;
// The disk may delay reading the journal by several seconds.
const ANSWER_LIMIT_MS = 10000;
// All events are in the journal.
const EVENTS_SHOWN = 100;
const REFUSED_SHOWN = 12;
const STATES = {
  running: ["▶", "running"],
  waiting: ["…", "waiting"],
  paused: ["‖", "paused"],
  complete: ["■", "complete"],
  incomplete: ["■", "ended, incomplete"],
  late: ["‖", "late"],
  silent: ["✕", "no sign of life"],
  stopped: ["✕", "stopped"],
  copy: ["⧉", "a copy"],
  gone: ["✕", "no session"],
  unreadable: ["✕", "cannot be read"],
  absent: ["…", "not started"],
  unknown: ["?", "state unknown"],
};
const LOUD = new Set(["paused", "late", "silent", "incomplete", "stopped", "complete"]);
const WHITE = "white";
const BLACK = "black";
const PACE = "pace";
const LINES = "red\u00a0─ green\u00a0╌ blue\u00a0┈";
// Titles and explanations of plots and checks (docs/reference/judge.md).
const CHECKS = {
  [WHITE]: [`Paper white: ${LINES}`, "Camera RGB of bare paper in the white frames, in percent of the first white frame"],
  [BLACK]: [`Light in dark frames: ${LINES}`, "Camera RGB of bare paper while the projector shows black, in counts"],
  [PACE]: ["Time per frame", "Time from one frame to the next"],
  projector: ["Projector", "Faults that the projector reports"],
  other_camera: ["Camera", "Whether model, serial number and frame size are those of the session"],
  settings: ["Camera settings", "Whether aperture, shutter time and ISO speed are as requested"],
  data: ["Photosites without counts", "Share of the photosites below half of the black level, as in a damaged file"],
  repeated: ["Difference from earlier frames", "By their noise: 1 is a new exposure, 0 a file of an earlier frame"],
  clipping: ["Saturated photosites", "Share of the photosites on the chart that are saturated"],
  exposure: ["Exposure", "Brightest level on the chart, in percent of the saturation level"],
  chart: ["Recognised marks of the chart", "Tags or paper areas that were recognised in the first white frame"],
  movement: ["Movement of the chart", "Distance from the position of the chart in the first white frame"],
  blur: ["Change of focus", "Blur compared with the first white frame; a positive value is less sharp"],
  rows: ["Rows with wrong content", "Quarter rows of the frame with other content than expected"],
  uniformity: ["Uneven light", "Largest deviation of a part of the frame from the light of this illuminant"],
  off_codes_deg: ["Colour of the illuminant", "Difference between the recorded colour and its prediction from the codes"],
  off_brightness: ["Brightness of the illuminant", "Difference from the brightness predicted from the codes"],
  dark_drift: ["Change of the light in dark frames", "Change since the first dark frame, in percent of white"],
  stray_share: ["Other light", "Light of the room that was added to several frames, in percent of white"],
  leak_share: ["Dark light relative to white", "Light while the projector shows black, in percent of white"],
  white_drift: ["Brightness of white", "Change of white since the first white frame"],
  additivity: ["White against the primaries", "Difference between white and the sum of red, green and blue"],
};
const titleOf = (name) => CHECKS[name]?.[0] ?? name;
const explanationOf = (name) => CHECKS[name]?.[1] ?? "";
// Plots in order of interest; other checks follow in the order of the journal.
const PLOT_ORDER = [
  WHITE,
  "white_drift",
  BLACK,
  "leak_share",
  "dark_drift",
  "stray_share",
  "movement",
  "blur",
  PACE,
  "off_codes_deg",
  "off_brightness",
  "uniformity",
  "repeated",
];

const $ = (id) => document.getElementById(id);
const embedded = $("embedded");
const model = {
  cursor: "",
  head: { state: "unknown", sentence: "" },
  session: null,
  frames: new Map(),
  events: [],
  begun: 0,
};
let chosen = null;
let allRefused = false;
let clockOffset = 0;
let answeredAt = Date.now();
let sound = null;
let drawn = { plots: [], strip: null };

const now = () => Date.now() + clockOffset;
// Local time as in ISO 8601, as in the title of the report and the files of a session.
const joined = (numbers, sign) => numbers.map((number) => String(number).padStart(2, "0")).join(sign);

function timeText(ms) {
  if (!ms) return "–";
  const at = new Date(ms);
  return joined([at.getHours(), at.getMinutes(), at.getSeconds()], ":");
}

function dayText(ms) {
  if (!ms) return "–";
  const at = new Date(ms);
  return `${joined([at.getFullYear(), at.getMonth() + 1, at.getDate()], "-")} ${timeText(ms)}`;
}

function durationText(seconds) {
  if (seconds === null || seconds === undefined) return "unknown";
  const whole = Math.max(0, Math.round(seconds));
  const hours = Math.floor(whole / 3600);
  const minutes = Math.floor((whole % 3600) / 60);
  const rest = whole % 60;
  if (hours) return `${hours} h ${String(minutes).padStart(2, "0")} min`;
  return minutes ? `${minutes} min ${String(rest).padStart(2, "0")} s` : `${rest} s`;
}

// State: changes are stored in the model ---------------------------------------------------------------------------

function take(state) {
  const before = model.head;
  const whole = state.session !== undefined;
  model.cursor = state.cursor;
  model.head = state.head;
  if (whole) {
    const same = model.session && model.session.name === state.session.name;
    model.session = state.session;
    model.frames = new Map();
    model.events = [];
    model.begun = 0;
    if (!same) chosen = null;
  }
  for (const frame of state.frames ?? []) model.frames.set(frame.id, frame);
  model.events = model.events.concat(state.events ?? []).slice(-EVENTS_SHOWN);
  for (const [at, what] of state.events ?? []) if (what === "start") model.begun = at;
  if (before.state !== model.head.state && answeredOnce) announceState();
  answeredOnce = true;
  if (whole) drawSession();
  const lives = before.alive !== model.head.alive;
  if (model.session && (whole || lives || (state.frames ?? []).length)) drawFrames(whole || lives, state.frames ?? []);
  if (whole || (state.events ?? []).length) drawEvents();
  drawHead();
}
let answeredOnce = false;

// Frames -----------------------------------------------------------------------------------------------------------

const inOrder = () => [...model.frames.values()].sort((one, other) => one.id - other.id);
const stepOf = (frame) => model.session.steps.get(frame.step);
/** Return whether an attempt is active: without a verdict before the newest start it was interrupted. */
const isOpen = (frame) => !frame.verdict && model.head.alive && frame.at >= model.begun;
const codesText = (codes) => codes.join(" ");
const fillOf = (codes) => `rgb(${codes.join(",")})`;

function nameOf(step) {
  if (!step) return "a frame outside the plan";
  if (step.kind !== "light") return `${step.kind} frame ${step.number}`;
  const light = model.session.lights.get(step.light);
  return `illuminant ${step.light}${light && light.cct ? ` (${short(light.cct)} K)` : ""}`;
}

/**
 * Return the frame to show: the chosen one, else the newest with a verdict.
 *
 * After the run, the newest lit frame is shown instead of the final dark frame.
 */
function frameShown(frames) {
  if (chosen !== null && model.frames.has(chosen)) return model.frames.get(chosen);
  const judged = frames.filter((frame) => frame.verdict);
  const lit = model.head.alive ? undefined : judged.findLast((frame) => stepOf(frame)?.kind !== "dark");
  return lit ?? judged[judged.length - 1] ?? null;
}

function drawSession() {
  const { session } = model;
  session.steps = new Map(
    session.steps.map(([number, kind, light, ...codes]) => [number, { number, kind, light, codes }]),
  );
  session.lights = new Map(
    session.lights.map(([index, kind, cct, at, ...codes]) => [index, { index, kind, cct, at, codes }]),
  );
  if (!embedded) $("name").textContent = session.name;
  drawn.planned.clear();
  drawn.seen.clear();
  $("records").replaceChildren(
    ...(session.records.length ? session.records : [["", "No records."]]).flatMap(([key, text]) => [
      element("dt", {}, key),
      element("dd", {}, text),
    ]),
  );
}

function drawFrames(whole, changed) {
  const frames = inOrder();
  const byLight = new Map();
  for (const frame of frames) {
    const step = stepOf(frame);
    if (step && step.kind === "light") byLight.set(step.light, [...(byLight.get(step.light) ?? []), frame]);
  }
  const touched = whole
    ? model.session.lights.keys()
    : new Set(changed.map((frame) => stepOf(frame)?.light).filter((light) => light !== null && light !== undefined));
  for (const light of touched) drawLight(light, byLight.get(light) ?? []);
  $("seen-note").hidden = frames.some((frame) => frame.seen_at);
  drawReach(frames);
  drawWall(frames);
  drawSeries(frames);
  drawRefused(frames);
  drawChoice(frames);
}

function drawLight(index, frames) {
  const light = model.session.lights.get(index);
  if (!light) return;
  const accepted = frames.findLast((frame) => frame.verdict === "accepted");
  const last = frames[frames.length - 1];
  const state =
    last && isOpen(last)
      ? "shown"
      : accepted
        ? "accepted"
        : frames.some((frame) => ["refused", "voided"].includes(frame.verdict))
          ? "refused"
          : "planned";
  const form = light.kind === "blackbody" ? "diamond" : "circle";
  const title = `illuminant ${index}, ${codesText(light.codes)}${light.cct ? `, ${short(light.cct)} K` : ""}: ${state}`;
  drawn.planned.plane.mark(index, light.at, { form, state, fill: fillOf(light.codes), title });
  const seen = accepted ?? frames.findLast((frame) => frame.seen_at);
  drawn.seen.plane.mark(index, seen?.seen_at ?? null, {
    form,
    state: accepted ? "accepted" : "refused",
    fill: fillOf(light.codes),
    title,
  });
}

/** Draw the triangle of the measured primaries: mixtures lie within it, because light adds. */
function drawReach(frames) {
  const primaries = [0, 1, 2].map((channel) =>
    frames.findLast((frame) => {
      const step = stepOf(frame);
      return (
        frame.seen_at && step?.kind === "response" && step.codes.every((code, at) => code > 0 === (at === channel))
      );
    }),
  );
  if (primaries.every(Boolean)) drawn.seen.plane.drawReach(primaries.map((frame) => frame.seen_at));
}

function drawWall(frames) {
  const last = frames[frames.length - 1];
  const open = last && isOpen(last) ? stepOf(last) : null;
  const swatch = $("swatch");
  if (!open) {
    swatch.style.background = "";
    swatch.setAttribute("aria-label", "unknown colour");
    $("wall").replaceChildren(model.head.alive ? "Between two frames" : "Unknown: no run is active");
    return;
  }
  swatch.style.background = fillOf(open.codes);
  swatch.setAttribute("aria-label", `sRGB ${codesText(open.codes)}`);
  $("wall").replaceChildren(
    element("b", {}, codesText(open.codes)),
    element("br"),
    `${nameOf(open)}, step ${open.number} of the plan, shown at ${timeText(last.at)}`,
  );
}

function choose(id, frames = inOrder()) {
  chosen = id;
  drawChoice(frames);
}

function stride(by) {
  const frames = inOrder();
  if (!frames.length) return;
  const at = frames.indexOf(frameShown(frames));
  const to = Math.max(0, Math.min(frames.length - 1, at + by));
  choose(to === frames.length - 1 && by > 0 ? null : frames[to].id, frames);
}

function drawChoice(frames) {
  const frame = frameShown(frames);
  const index = frames.indexOf(frame);
  const light = frame ? (stepOf(frame)?.light ?? null) : null;
  const newest = frame && stepOf(frame) && !model.head.alive ? `Last ${stepOf(frame).kind} frame` : "Last frame";
  $("frame-title").textContent = chosen === null ? newest : "Chosen frame";
  $("latest").disabled = chosen === null;
  $("previous").disabled = index <= 0;
  $("next").disabled = index < 0 || index >= frames.length - 1;
  for (const side of ["planned", "seen"]) drawn[side].plane.choose(light);
  for (const plot of [...drawn.plots, drawn.strip]) {
    if (!plot) continue;
    plot.cursor.setAttribute("visibility", frame ? "visible" : "hidden");
    const x = across(index, frames.length, plot === drawn.strip ? STRIP : PLOT);
    plot.cursor.setAttribute("x1", x);
    plot.cursor.setAttribute("x2", x);
  }
  drawPicture(frame);
  if (!frame) return;
  const step = stepOf(frame);
  const verdict = frame.verdict || (isOpen(frame) ? "active" : "interrupted");
  $("frame-caption").replaceChildren(
    `${nameOf(step)}, shown as ${step ? codesText(step.codes) : "?"}, at ${dayText(frame.taken ?? frame.at)}: `,
    element("b", frame.verdict === "accepted" ? {} : { class: "bad" }, verdict),
    frame.reason ? `: ${frame.reason}` : "",
  );
  $("checks").tBodies[0].replaceChildren(
    ...(frame.checks ?? []).map(([name, unit, value, low, high, reason]) => {
      const beyond = value !== null && ((low !== null && value < low) || (high !== null && value > high));
      const mark = beyond && !reason ? " (beyond its limit, but not a reason for refusal)" : "";
      const result = value !== null ? `${withUnit(value, unit)}${mark}` : reason ? "refused" : "no fault";
      return element(
        "tr",
        reason ? { class: "bad" } : {},
        element("th", { scope: "row", title: explanationOf(name) }, `${reason ? "✕ " : ""}${titleOf(name)}`),
        element("td", { class: "number" }, result),
        element("td", { class: "number note" }, limitText(low, high, unit)),
      );
    }),
  );
  const timings = Object.entries(frame.timings ?? {}).map(
    // Less than 1 ms is shown as 0.
    ([name, seconds]) => `${name} ${seconds < 0.001 ? "0" : short(seconds)} s`,
  );
  $("timings").textContent = timings.length ? `Time: ${timings.join(", ")}` : "";
}

function pictureOf(frame) {
  if (embedded) return model.pictures[frame.id] ?? null;
  return frame.preview ? `frame/${frame.id}.jpg?${frame.preview}` : null;
}

function drawPicture(frame) {
  const source = frame ? pictureOf(frame) : null;
  const picture = $("picture");
  const without = $("no-picture");
  picture.hidden = source === null;
  without.hidden = source !== null;
  without.textContent = !frame
    ? "No frame yet"
    : frame.preview
      ? "This report does not include the preview"
      : "This frame has no preview";
  if (source === null) {
    picture.removeAttribute("src");
    return;
  }
  if (picture.getAttribute("src") !== source) picture.src = source;
  picture.alt = `${nameOf(stepOf(frame))}: ${frame.verdict || "active"}${frame.reason ? `, ${frame.reason}` : ""}`;
}

// Polling -----------------------------------------------------------------------------------------------------------

async function poll() {
  try {
    const limit = new AbortController();
    const timer = setTimeout(() => limit.abort(), ANSWER_LIMIT_MS);
    const request = fetch(`state.json?since=${encodeURIComponent(model.cursor)}`, {
      cache: "no-store",
      signal: limit.signal,
    });
    const answer = await request.finally(() => clearTimeout(timer));
    if (!answer.ok) throw new Error(`answered ${answer.status}`);
    answeredAt = Date.now();
    clockOffset = Date.parse(answer.headers.get("Date")) + 500 - answeredAt;
    if (answer.status !== 204) take(await answer.json());
  } catch (error) {
    // A server that does not answer is reported by drawClock; other errors go to the console.
    if (!["TypeError", "AbortError"].includes(error.name) && !String(error.message).startsWith("answered"))
      console.error(error);
  }
  drawClock();
  waiting = setTimeout(poll, document.hidden ? POLL_HIDDEN_MS : POLL_MS);
}
let waiting = null;

function legend() {
  const mark = (state, form, text) => {
    const path = shape("path", { class: `mark ${state}`, d: markPath(form, 8, 8, 4.5) });
    if (state === "accepted" || state === "shown") path.setAttribute("fill", "#c9a227");
    return element("li", {}, shape("svg", { viewBox: "0 0 16 16", "aria-hidden": "true" }, path), text);
  };
  $("legend").replaceChildren(
    mark("planned", "circle", "planned"),
    mark("accepted", "circle", "accepted"),
    mark("accepted", "diamond", "accepted, black body"),
    mark("shown", "circle", "on the wall"),
    mark("refused", "cross", "refused"),
  );
  $("lights-note").textContent =
    "Each illuminant at r = R/(R+G+B), b = B/(R+G+B), in its own colour. " +
    "If a mark is at another position in the measured plane, the frame shows another illuminant than ordered.";
}

function planeIn(id, label) {
  const box = $(id);
  const plane = () =>
    new Plane(box, label, (light) => {
      const frame = inOrder().findLast((candidate) => stepOf(candidate)?.kind === "light" && stepOf(candidate).light === light);
      if (frame) choose(frame.id);
    });
  const view = { plane: plane() };
  view.clear = () => {
    box.replaceChildren();
    view.plane = plane();
  };
  return view;
}

function begin() {
  drawn.planned = planeIn("planned", "Planned chromaticities of the illuminants");
  drawn.seen = planeIn("seen", "Measured chromaticities of the illuminants");
  legend();
  $("previous").addEventListener("click", () => stride(-1));
  $("next").addEventListener("click", () => stride(1));
  $("latest").addEventListener("click", () => choose(null));
  $("more").addEventListener("click", () => {
    allRefused = !allRefused;
    drawRefused(inOrder());
  });
  $("verdicts").addEventListener("click", (event) => chooseAt(event, STRIP));
  $("series").addEventListener("click", (event) => chooseAt(event, PLOT));
  $("picture").addEventListener("error", () => {
    $("picture").hidden = true;
    $("no-picture").hidden = false;
  });
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.altKey || event.metaKey) return;
    const frames = inOrder();
    // Home and End scroll the page unless the focus is on a plot.
    if (["Home", "End"].includes(event.key) && !document.activeElement.closest("#planned, #seen, #series")) return;
    const acts = {
      ArrowLeft: () => stride(-1),
      ArrowRight: () => stride(1),
      Home: () => frames.length && choose(frames[0].id, frames),
      End: () => choose(null),
      Escape: () => choose(null),
    };
    if (!acts[event.key]) return;
    acts[event.key]();
    event.preventDefault();
  });
  if (embedded) {
    $("sound").hidden = true;
    const state = JSON.parse(embedded.textContent);
    model.pictures = state.pictures;
    take(state);
    return;
  }
  $("sound").addEventListener("click", () => {
    sound = sound ? (sound.close(), null) : new AudioContext();
    $("sound").setAttribute("aria-pressed", String(Boolean(sound)));
    $("sound").textContent = sound ? "Sound on" : "Sound off";
    if (sound) beep(1);
  });
  document.addEventListener("visibilitychange", () => {
    if (document.hidden) return;
    clearTimeout(waiting);
    poll();
  });
  setInterval(drawClock, 1000);
  poll();
}

begin();
