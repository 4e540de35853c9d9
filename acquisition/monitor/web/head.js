// The head of the page: state, progress and remedy. Called from page.js, whose model it shows.

function fact(name, value, bad = false) {
  return element("div", {}, element("dt", {}, name), element("dd", bad ? { class: "bad" } : {}, value));
}

function drawHead() {
  const { head } = model;
  const [glyph, word] = STATES[head.state] ?? STATES.unknown;
  $("top").dataset.state = head.state;
  $("state").textContent = `${glyph} ${word}`;
  const share = head.total ? head.done / head.total : 0;
  $("bar").style.width = `${(100 * share).toFixed(2)}%`;
  const bar = $("progress");
  bar.setAttribute("aria-valuemax", head.total || 1);
  bar.setAttribute("aria-valuenow", head.done ?? 0);
  bar.setAttribute("aria-valuetext", `${head.done ?? 0} of ${head.total ?? 0} frames`);
  document.title = `${glyph} ${head.done ?? 0}/${head.total ?? 0} ${$("name").textContent}`;
  drawIcon(share);
  const facts = [];
  if (head.total) {
    facts.push(
      fact("illuminants", `${head.lights_done} of ${head.lights_total}`),
      fact("frames", `${head.done} of ${head.total}`),
    );
    if (head.done < head.total)
      facts.push(fact("time left", head.alive ? durationText(head.remaining_s) : "no run active", !head.alive));
    if (head.eta && head.alive) facts.push(fact("complete at about", timeText(head.eta)));
    if (head.seconds_per_frame) facts.push(fact("time per frame", `${short(head.seconds_per_frame)} s`));
    facts.push(
      fact("refused", String(head.refused), head.refused > 0),
      fact("failed", String(head.failed), head.failed > 0),
    );
    if (head.voided) facts.push(fact("voided", String(head.voided), true));
  }
  if (head.last) facts.push(fact("last frame", timeText(head.last)));
  if (!embedded && head.beat && head.state !== "complete") facts.push(element("div", { id: "beat" }));
  $("facts").replaceChildren(...facts);
  document.body.classList.toggle("no-wall", Boolean(embedded) || head.state === "complete");
  drawBanner();
  drawClock();
}

function drawBanner() {
  const { head } = model;
  const banner = $("banner");
  const quiet = head.state === "running" || !head.sentence;
  banner.hidden = quiet;
  banner.className = ["stopped", "silent", "incomplete", "gone", "unreadable"].includes(head.state)
    ? "bad"
    : head.state === "complete"
      ? "good"
      : "";
  // A sentence has the form "fault; remedy (duration)". The duration is shown separately, because it changes all the
  // time and must not be read aloud by a screen reader.
  const [, text, lasts] = (quiet ? "" : head.sentence).match(/^(.*?)(?: \(([^()]*)\))?$/s);
  const [fault, ...remedy] = text.split("; ");
  if ($("banner-text").dataset.text !== text) {
    $("banner-text").dataset.text = text;
    $("banner-text").replaceChildren(element("strong", {}, fault), remedy.join("; "));
  }
  $("countdown").textContent = lasts ?? "";
}

/** Draw the age of the last sign of life, and whether the server answers. */
function drawClock() {
  if (embedded) return;
  const { head } = model;
  const late = head.alive && head.until && now() > head.until;
  const beat = $("beat");
  if (beat)
    beat.replaceChildren(
      element("dt", {}, "sign of life"),
      element(
        "dd",
        {},
        head.alive ? `${durationText((now() - head.beat) / 1000)} ago${late ? ", late" : ""}` : dayText(head.beat),
      ),
    );
  const silent = Date.now() - answeredAt > 2 * ANSWER_LIMIT_MS;
  $("offline").hidden = !silent;
  if (silent)
    $("offline").textContent =
      `acquire monitor has not answered since ${timeText(answeredAt)}; this page is out of date. ` +
      "The run itself may be active: check its terminal, or start acquire monitor again.";
}

/** Draw the icon of the tab: a ring for the progress, in the colour of the state. */
function drawIcon(share) {
  const colours = { running: "#2f8fd0", complete: "#2f8fd0", waiting: "#e0a000", paused: "#e0a000", late: "#e0a000" };
  const colour = colours[model.head.state] ?? "#d9541e";
  const round = 2 * Math.PI * 11;
  const circle = (stroke, more) =>
    `<circle cx="16" cy="16" r="11" fill="none" stroke="${stroke}" stroke-width="8" ${more}/>`;
  const filling = `stroke-dasharray="${round * share} ${round}" transform="rotate(-90 16 16)"`;
  const svg = `<svg xmlns="${SVG}" viewBox="0 0 32 32">${circle("#8888", "")}${circle(colour, filling)}</svg>`;
  document.querySelector("link[rel=icon]").href = `data:image/svg+xml,${encodeURIComponent(svg)}`;
}

function announceState() {
  const [, word] = STATES[model.head.state] ?? STATES.unknown;
  $("said").textContent = `The run is now: ${word}. ${model.head.sentence}`;
  if (sound && LOUD.has(model.head.state)) beep(model.head.state === "complete" ? 1 : 3);
}

function beep(times) {
  for (let index = 0; index < times; index += 1) {
    const tone = sound.createOscillator();
    const gain = sound.createGain();
    gain.gain.value = 0.2;
    tone.frequency.value = 660;
    tone.connect(gain).connect(sound.destination);
    tone.start(sound.currentTime + 0.4 * index);
    tone.stop(sound.currentTime + 0.4 * index + 0.22);
  }
}
