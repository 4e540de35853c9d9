// The page of a table: what is chosen, and who is told of it.

const RENDERINGS = { codes: "By codes", colorimetric: "By colour" };
const VIEWS = {
  camera: "In the camera's own colours, tone mapped with the Flash operator as previews of datasets are.",
  balanced: "Divided by the ground truth: what is grey is grey, but for what the print does to colours.",
  counts: "Linear, saturation is white: as most programs show the file of a dataset.",
};
/** How far a chromaticity may be from the one that was asked for and count as it: a hundredth of a degree. */
const SAME = 2e-4;

const state = { picture: 0, base: "0", parts: [[0, 1]], other: "", share: 0.5, view: "camera", at: null, wanted: null };
let table = null;
let plane = null;
let panels = [];
let shown = null;
const own = [];

/** Return the light that is chosen as the program takes it. */
function lightText() {
  if (state.other === "") return state.base;
  const other = Number(state.other);
  const parts = new Map();
  for (const [light, weight] of [...state.parts.map(([light, weight]) => [light, weight * (1 - state.share)]), [other, state.share]])
    parts.set(light, (parts.get(light) ?? 0) + weight);
  const kept = [...parts].filter(([, weight]) => weight > 1e-9);
  return kept.length === 1 ? String(kept[0][0]) : kept.map(([light, weight]) => `${light}:${weight.toFixed(9)}`).join("+");
}

function fault(text) {
  $("fault").hidden = !text;
  $("fault").textContent = text;
}

const look = () => ({ view: state.view, truth: shown.truth, at: state.at });

/** Ask what the chosen light makes of the chosen picture, and have it drawn. */
const update = newest(async () => {
  const { picture, wanted } = state;
  try {
    shown = await (await ask(`shown.json?${new URLSearchParams({ picture, light: lightText() })}`)).json();
  } catch (error) {
    fault(error.message);
    return;
  }
  fault("");
  if (state.other === "") state.parts = shown.parts;
  drawLight(wanted);
  drawPicture();
  drawCommands();
  for (const panel of panels) panel.show(picture, shown.light, look);
  measure();
});

function drawLight(wanted) {
  plane.choose(shown.rb, shown.parts);
  const [red, green, blue] = shown.truth;
  const swatch = element("span", { class: "swatch", role: "img", "aria-label": "colour of the light as the camera sees it" });
  const brightest = Math.max(red, green, blue);
  swatch.style.backgroundColor = `rgb(${[red, green, blue].map((part) => Math.round(255 * (part / brightest) ** (1 / GAMMA)))})`;
  const far = wanted && Math.hypot(shown.rb[0] - wanted[0], shown.rb[1] - wanted[1]) > SAME;
  const parts = shown.parts.map(([light, weight]) => {
    const name = `light ${light} (${table.lights[light].label})`;
    return shown.parts.length > 1 ? `${short(weight)} × ${name}` : name;
  });
  const facts = [
    ["ground truth", `r ${short(red)}  g ${short(green)}  b ${short(blue)}`],
    ["made of", parts.join(" + ") + (far ? "; the nearest that the table can make" : "")],
  ];
  const pairs = facts.flatMap(([name, text], index) => {
    return [element("dt", {}, name), element("dd", {}, ...(index ? [] : [swatch]), text)];
  });
  $("light-facts").replaceChildren(...pairs);
  $("said").textContent = `ground truth ${facts[0][1]}, made of ${facts[1][1]}`;
  $("share-text").textContent = state.other === "" ? "" : `${Math.round(100 * state.share)} %`;
  $("share").disabled = state.other === "";
  const only = state.other === "" && shown.parts.length === 1 ? String(shown.parts[0][0]) : null;
  if (state.other === "") $("light").value = only ?? "";
  if (document.activeElement !== $("text")) $("text").value = shown.light;
}

function drawPicture() {
  const { name, width, height, profile } = shown.picture;
  const all = table.pictures + own.length;
  const place = order().indexOf(state.picture) + 1;
  $("picture-name").textContent = `${name}, ${width} × ${height} px (${place} of ${all}); profile ${profile}`;
  for (const id of ["previous", "next"]) $(id).disabled = all < 2;
}

function drawCommands() {
  $("command-note").textContent = shown.is_here
    ? "Run where generate explore was started, it makes these very counts; with the picture's folder for the picture, of all that are in it."
    : "A browser does not tell where a picture lies: run it in the picture's folder, and it makes these very counts.";
  const made = Object.entries(RENDERINGS).flatMap(([rendering, title]) => {
    const code = element("code", { id: `command-${rendering}` }, shown.commands[rendering]);
    const button = element("button", { type: "button", class: "copy", "aria-label": `Copy the command, ${title}` }, "Copy");
    button.addEventListener("click", () => copy(code, button));
    return [element("b", {}, title), element("div", { class: "command" }, code, button)];
  });
  $("commands").replaceChildren(...made);
}

/** Copy a text; where the browser allows that to nobody, as without TLS from another machine, select it. */
async function copy(code, button) {
  try {
    await navigator.clipboard.writeText(code.textContent);
    button.textContent = "Copied";
  } catch {
    getSelection().selectAllChildren(code);
    button.textContent = "Selected";
  }
}

// What is chosen ---------------------------------------------------------------------------------------------------

function choose(change) {
  Object.assign(state, { wanted: null }, change);
  update();
}

function pick(number) {
  $("other").value = "";
  choose({ base: String(number), other: "" });
}

/** Go to the light of the table that is so many after the first that the chosen one is made of. */
function stepLight(by) {
  pick(((shown?.parts[0][0] ?? 0) + by + table.lights.length) % table.lights.length);
}

function move(rb) {
  $("other").value = "";
  choose({ base: `r=${rb[0].toFixed(5)},b=${rb[1].toFixed(5)}`, other: "", wanted: rb });
}

/** Return the numbers of the pictures in their order: those of the program, then those of this page. */
const order = () => [...Array(table.pictures).keys(), ...own];

function step(by) {
  const all = order();
  choose({ picture: all[(all.indexOf(state.picture) + by + all.length) % all.length], at: null });
}

async function send(file) {
  try {
    const query = new URLSearchParams({ name: file.name });
    const answer = await ask(`picture?${query}`, { method: "PUT", body: file });
    own.push((await answer.json()).picture);
  } catch (error) {
    fault(error.message);
    return;
  }
  choose({ picture: own[own.length - 1], at: null });
}

/** Look at a pixel [x, y], or one that is so far from the last. */
function point(place, relative = false) {
  if (!shown) return;
  const { width, height } = shown.picture;
  const from = relative ? (state.at ?? [width >> 1, height >> 1]) : [0, 0];
  const most = [width - 1, height - 1];
  state.at = place.map((value, axis) => Math.min(Math.max(from[axis] + value, 0), most[axis]));
  for (const panel of panels) panel.point(state.at);
  measure();
}

function measure() {
  if (!state.at || !shown) return;
  const [x, y] = state.at;
  for (const panel of panels) panel.measure(shown.number, shown.light, state.at);
  $("pixel-note").textContent =
    `Pixel ${x}, ${y}. Each pixel is one draw; mean and standard deviation are those of 256 draws of the same colour.`;
}

function listen() {
  const options = table.lights.map(({ label }, number) => element("option", { value: number }, `${number}: ${label}`));
  $("light").append(element("option", { value: "", disabled: "" }, "a mixture"), ...options);
  $("other").append(element("option", { value: "" }, "nothing"), ...options.map((option) => option.cloneNode(true)));
  $("light").addEventListener("change", () => choose({ base: $("light").value, parts: [[Number($("light").value), 1]] }));
  $("other").addEventListener("change", () => choose({ other: $("other").value }));
  $("share").addEventListener("input", () => choose({ share: Number($("share").value) }));
  $("write").addEventListener("submit", (event) => {
    event.preventDefault();
    $("other").value = "";
    choose({ base: $("text").value.trim(), other: "" });
  });
  for (const radio of document.querySelectorAll("input[name=view]"))
    radio.addEventListener("change", () => {
      state.view = radio.value;
      $("view-note").textContent = VIEWS[state.view];
      if (shown) for (const panel of panels) panel.draw(look());
    });
  $("previous").addEventListener("click", () => step(-1));
  $("next").addEventListener("click", () => step(1));
  $("open").addEventListener("click", () => $("file").click());
  $("file").addEventListener("change", () => $("file").files.length && send($("file").files[0]));
  addEventListener("dragover", (event) => {
    event.preventDefault();
    document.body.classList.add("dropping");
  });
  addEventListener("dragleave", () => document.body.classList.remove("dropping"));
  addEventListener("drop", (event) => {
    event.preventDefault();
    document.body.classList.remove("dropping");
    if (event.dataTransfer.files.length) send(event.dataTransfer.files[0]);
  });
}

async function begin() {
  try {
    table = await (await ask("table.json")).json();
  } catch (error) {
    fault(error.message);
    return;
  }
  const made = table.computed ? "a computed table" : "a table";
  $("table").textContent =
    `${table.name} is ${made} of ${table.lights.length} lights and ${table.colours} printed colours, ${table.samples} samples of each.`;
  $("view-note").textContent = VIEWS[state.view];
  panels = Object.entries(RENDERINGS).map(([name, title]) => new Panel(name, title, table.white_level, point));
  plane = new Plane($("plane"), table, pick, stepLight, move);
  listen();
  pick(table.first);
}

begin();
