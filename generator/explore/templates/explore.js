// The page of a LUT: the selection, and the updates of all panels.

const RENDERINGS = { colorimetric: "By colour", codes: "By codes" };
const VIEWS = {
  camera: "Camera RGB, tone mapped with the Flash operator like the previews of data sets.",
  balanced: "Divided by the ground truth. Grey surfaces are grey, except for colour errors of the print.",
  counts: "Linear counts, with saturation as white. Most programs show the files of a data set like this.",
};
/** Largest distance at which two chromaticities count as equal, about 0.01 degrees. */
const EQUAL = 2e-4;

const state = { picture: 0, base: "0", parts: [[0, 1]], other: "", share: 0.5, view: "camera", at: null, target: null };
let table = null;
let plane = null;
let panels = [];
let shown = null;
const uploads = [];

/** Return the selected illuminant as text for the program. */
function lightText() {
  if (state.other === "") return state.base;
  const other = Number(state.other);
  const parts = new Map();
  for (const [light, weight] of [...state.parts.map(([light, weight]) => [light, weight * (1 - state.share)]), [other, state.share]])
    parts.set(light, (parts.get(light) ?? 0) + weight);
  const used = [...parts].filter(([, weight]) => weight > 1e-9);
  return used.length === 1 ? String(used[0][0]) : used.map(([light, weight]) => `${light}:${weight.toFixed(9)}`).join("+");
}

function fault(text) {
  $("fault").hidden = !text;
  $("fault").textContent = text;
}

const display = () => ({ view: state.view, truth: shown.truth, at: state.at });

/** Request the selected picture under the selected illuminant, and redraw the page. */
const update = newest(async () => {
  const { picture, target } = state;
  try {
    shown = await (await ask(`shown.json?${new URLSearchParams({ picture, light: lightText() })}`)).json();
  } catch (error) {
    fault(error.message);
    return;
  }
  fault("");
  state.at ??= [shown.picture.width >> 1, shown.picture.height >> 1];
  if (state.other === "") state.parts = shown.parts;
  drawLight(target);
  drawPicture();
  drawCommands();
  for (const panel of panels) panel.show(picture, shown.light, display);
  measure();
});

function drawLight(target) {
  plane.choose(shown.rb, shown.parts);
  const [red, green, blue] = shown.truth;
  const swatch = element("span", { class: "swatch", role: "img", "aria-label": "colour of the illuminant in camera RGB" });
  const brightest = Math.max(red, green, blue);
  swatch.style.backgroundColor = `rgb(${[red, green, blue].map((channel) => Math.round(255 * (channel / brightest) ** (1 / GAMMA)))})`;
  const isOutside = target && Math.hypot(shown.rb[0] - target[0], shown.rb[1] - target[1]) > EQUAL;
  const parts = shown.parts.map(([light, weight]) => {
    const name = `illuminant ${light} (${table.lights[light].label})`;
    return shown.parts.length > 1 ? `${short(weight)} × ${name}` : name;
  });
  const facts = [
    ["ground truth", `r ${short(red)}  g ${short(green)}  b ${short(blue)}`],
    ["mixture", parts.join(" + ") + (isOutside ? "; the nearest chromaticity in the gamut" : "")],
  ];
  const pairs = facts.flatMap(([name, text], index) => {
    return [element("dt", {}, name), element("dd", {}, ...(index ? [] : [swatch]), text)];
  });
  $("light-facts").replaceChildren(...pairs);
  $("announcement").textContent = `ground truth ${facts[0][1]}, mixture ${facts[1][1]}`;
  $("share-text").textContent = state.other === "" ? "" : `${Math.round(100 * state.share)} %`;
  $("share").disabled = state.other === "";
  const single = state.other === "" && shown.parts.length === 1 ? String(shown.parts[0][0]) : null;
  if (state.other === "") $("light").value = single ?? "";
  if (document.activeElement !== $("text")) $("text").value = shown.light;
}

function drawPicture() {
  const { name, width, height, profile } = shown.picture;
  const total = table.pictures + uploads.length;
  const position = order().indexOf(state.picture) + 1;
  $("picture-name").textContent = `${name}, ${width} × ${height} px (${position} of ${total}); profile ${profile}`;
  for (const id of ["previous", "next"]) $(id).disabled = total < 2;
}

function drawCommands() {
  $("command-note").textContent = shown.is_here
    ? "Run it in the folder in which generate explore was started; it makes exactly these counts. Give the folder instead of the picture to use all its pictures."
    : "Run it in the folder of the picture, which the browser does not report; it makes exactly these counts.";
  const rows = Object.entries(RENDERINGS).flatMap(([rendering, title]) => {
    // No line ends after the hyphens of an option.
    const words = shown.commands[rendering].split(/(--[a-z-]+)/);
    const texts = words.map((word) => (word.startsWith("--") ? element("span", { class: "unbroken" }, word) : word));
    const code = element("code", { id: `command-${rendering}` }, ...texts);
    const button = element("button", { type: "button", class: "copy", "aria-label": `Copy the command, ${title}` }, "Copy");
    button.addEventListener("click", () => copy(code, button));
    return [element("b", {}, title), element("div", { class: "command" }, code, button)];
  });
  $("commands").replaceChildren(...rows);
}

/** Copy a text, or select it if the browser forbids copying, as from another machine without TLS. */
async function copy(code, button) {
  try {
    await navigator.clipboard.writeText(code.textContent);
    button.textContent = "Copied";
  } catch {
    getSelection().selectAllChildren(code);
    button.textContent = "Selected";
  }
}

// Selection ---------------------------------------------------------------------------------------------------

function choose(change) {
  Object.assign(state, { target: null }, change);
  update();
}

function pick(number) {
  $("other").value = "";
  choose({ base: String(number), other: "" });
}

/** Select an illuminant of the LUT, counted from the first one of the current mixture. */
function stepLight(by) {
  pick(((shown?.parts[0][0] ?? 0) + by + table.lights.length) % table.lights.length);
}

function move(rb) {
  $("other").value = "";
  choose({ base: `r=${rb[0].toFixed(5)},b=${rb[1].toFixed(5)}`, other: "", target: rb });
}

/** Return the numbers of all pictures: those of the program, then uploads. */
const order = () => [...Array(table.pictures).keys(), ...uploads];

function step(by) {
  const numbers = order();
  choose({ picture: numbers[(numbers.indexOf(state.picture) + by + numbers.length) % numbers.length], at: null });
}

async function send(file) {
  try {
    const query = new URLSearchParams({ name: file.name });
    const answer = await ask(`picture?${query}`, { method: "PUT", body: file });
    uploads.push((await answer.json()).picture);
  } catch (error) {
    fault(error.message);
    return;
  }
  choose({ picture: uploads[uploads.length - 1], at: null });
}

/** Select a pixel [x, y], or one relative to the last pixel. */
function point(position, relative = false) {
  if (!shown) return;
  const { width, height } = shown.picture;
  const origin = relative ? state.at : [0, 0];
  const largest = [width - 1, height - 1];
  state.at = position.map((value, axis) => Math.min(Math.max(origin[axis] + value, 0), largest[axis]));
  for (const panel of panels) panel.point(state.at);
  measure();
}

function measure() {
  if (!shown) return;
  const [x, y] = state.at;
  for (const panel of panels) panel.measure(shown.number, shown.light, state.at);
  $("pixel-note").textContent =
    `Pixel ${x}, ${y}; click a picture or use the arrow keys for another one. Each pixel is one sample; mean and standard deviation are of 256 samples of the same colour.`;
}

function listen() {
  const options = table.lights.map(({ label }, number) => element("option", { value: number }, `${number}: ${label}`));
  $("light").append(element("option", { value: "", disabled: "" }, "mixture"), ...options);
  $("other").append(element("option", { value: "" }, "none"), ...options.map((option) => option.cloneNode(true)));
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
      if (shown) for (const panel of panels) panel.draw(display());
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
  const kind = table.computed ? "a computed LUT" : "a LUT";
  $("table").textContent =
    `${table.name} is ${kind} with ${table.lights.length} illuminants and ${table.colours} printed colours, ${table.samples} samples of each.`;
  $("view-note").textContent = VIEWS[state.view];
  panels = Object.entries(RENDERINGS).map(([name, title]) => new Panel(name, title, table.white_level, point));
  plane = new Plane($("plane"), table, pick, stepLight, move);
  listen();
  pick(table.first);
}

begin();
