// Film strip: an episode in up to three cameras, scrubbed with a slider, the keyboard or the film itself.
"use strict";
const FILM_CELLS = 14;
const FRAMES_PER_SECOND = 10;

function showStrips(host) {
  if (!host || !content.strips.length) return;
  const panel = el("div", {});
  const choices = content.strips.map((strip, index) => [index, `${strip.mode}: episode ${strip.episode}`]);
  let player = null;
  const tabs = choiceButtons("Episode", choices, (index) => {
    if (player) player.stop();
    player = makePlayer(content.strips[index], panel);
  });
  host.append(el("div", { class: "tools" }, tabs.group), panel);
  whenSeen(panel, () => tabs.select(0));
}

function makePlayer(strip, panel) {
  const last = strip.frames.length - 1;
  const canvases = strip.cameras.map((_, camera) => el("canvas", { role: "img", "aria-label": `Camera ${camera}` }));
  const slider = el("input", { type: "range", min: 0, max: last, value: 0, "aria-label": "Frame" });
  const output = el("output", {});
  const button = el("button", { type: "button", class: "solo" }, "Play");
  const line = el("div", { class: "head-line" });
  const film = makeFilm(strip, line);
  const note = el("p", { class: "caption" });
  let timer = null;

  async function show() {
    const index = Number(slider.value);
    const frame = strip.frames[index];
    line.style.left = `${100 * (frame + 0.5) / strip.total}%`;
    output.textContent = `frame ${frame} of ${strip.total}, ${(frame * strip.period).toFixed(1)} s`;
    slider.setAttribute("aria-valuetext", output.textContent);
    const running = strip.attempts.find((attempt) => attempt.first <= frame && frame <= attempt.last);
    note.textContent = running ? `Attempt ${running.attempt}: ${running.sentence}.` : `This episode: ${strip.sentence}.`;
    const images = await Promise.all(strip.cameras.map((pictures) => loadPicture(pictures[index])));
    if (index !== Number(slider.value)) return;
    images.forEach((image, camera) => drawInto(canvases[camera], image));
    if (index < last) strip.cameras.forEach((pictures) => loadPicture(pictures[index + 1]));
  }
  function stop() {
    clearInterval(timer);
    timer = null;
    button.textContent = "Play";
  }
  function play() {
    if (Number(slider.value) === last) slider.value = 0;
    button.textContent = "Stop";
    timer = setInterval(() => {
      if (Number(slider.value) === last) return stop();
      slider.value = Number(slider.value) + 1;
      show();
    }, 1000 / FRAMES_PER_SECOND);
  }
  slider.addEventListener("input", show);
  button.addEventListener("click", () => (timer ? stop() : play()));
  dragFilm(film, strip, (index) => { slider.value = index; show(); });
  const cameras = canvases.map((canvas, camera) => el("figure", {}, canvas, el("figcaption", {}, `Camera ${camera}`)));
  const keys = el("p", { class: "hint" }, el("kbd", {}, "←"), " ", el("kbd", {}, "→"), " step, ", el("kbd", {}, "Home"), " ", el("kbd", {}, "End"),
    ` on the slider; drag the film. ${strip.frames.length} of ${strip.total} frames are kept.`,
    strip.attempts.length ? " Bars below the film are attempts: green picked an object, red did not." : "");
  panel.replaceChildren(el("div", { class: "cameras" }, cameras), film, makeSpans(strip), el("div", { class: "scrub" }, button, slider, output), note, keys);
  show();
  return { stop };
}

function drawInto(canvas, image) {
  canvas.width = image.naturalWidth;
  canvas.height = image.naturalHeight;
  canvas.getContext("2d").drawImage(image, 0, 0);
}

/** Cells of camera 0, evenly spread over the episode. */
function makeFilm(strip, line) {
  const count = Math.min(FILM_CELLS, strip.frames.length);
  const cells = Array.from({ length: count }, (_, cell) => {
    const index = Math.floor((cell + 0.5) * strip.frames.length / count);
    return el("img", { src: pictureAddress(strip.cameras[0][index]), alt: "" });
  });
  return el("div", { class: "film", "aria-hidden": "true" }, cells, line);
}

function makeSpans(strip) {
  const spans = strip.attempts.map((attempt) => {
    const span = el("i", { class: attempt.success ? "success" : "", title: `Attempt ${attempt.attempt}: ${attempt.sentence}` });
    span.style.left = `${100 * attempt.first / strip.total}%`;
    span.style.width = `${100 * (attempt.last + 1 - attempt.first) / strip.total}%`;
    return span;
  });
  return el("div", { class: "spans" }, spans);
}

/** Choose the nearest kept frame while the pointer is pressed on the film. */
function dragFilm(film, strip, choose) {
  function pick(event) {
    const place = film.getBoundingClientRect();
    const frame = (event.clientX - place.left) / place.width * strip.total;
    let best = 0;
    strip.frames.forEach((each, index) => { if (Math.abs(each - frame) < Math.abs(strip.frames[best] - frame)) best = index; });
    choose(best);
  }
  film.addEventListener("pointerdown", (event) => { film.setPointerCapture(event.pointerId); pick(event); });
  film.addEventListener("pointermove", (event) => { if (event.buttons) pick(event); });
}
