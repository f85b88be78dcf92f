// Sampled frames: a base picture (colour, depth, layers), and above it visible masks and boxes that can be switched on.
"use strict";
const MASK_ALPHA = 130;
const frameState = { base: "rgb", masks: false, boxes: false };
const cards = [];

function frameCaption(frame) {
  const light = frame.light ? `, light ${frame.light}` : "";
  const visible = frame.instances.filter((one) => one.visible > 0).length;
  return el("figcaption", {}, el("b", {}, `Episode ${frame.episode} (${frame.mode}), frame ${frame.frame}, camera ${frame.camera}`),
    `${light}. ${visible} of ${frame.instances.length} instances visible. `, el("span", { class: "shown" }));
}

/** A frame with its overlays; `update` applies the state. */
function frameCard(frame, opened) {
  const [width, height] = frame.size;
  const image = el("img", { alt: `Episode ${frame.episode}, frame ${frame.frame}, camera ${frame.camera}`, decoding: "async" });
  const canvas = el("canvas");
  const boxes = el("svg:svg", { viewBox: `0 0 ${width} ${height}`, preserveAspectRatio: "none", "aria-hidden": "true" });
  const stage = el("div", { class: "stage", tabindex: opened ? null : "0", role: opened ? null : "button", "aria-label": "Enlarge" }, image, canvas, boxes);
  stage.style.aspectRatio = `${width} / ${height}`;
  const caption = frameCaption(frame);
  const card = { frame, node: el("figure", {}, stage, caption), stage, ids: null, hovered: 0, visible: false };

  card.update = () => {
    if (!card.visible) return;
    const shown = frame.pictures[frameState.base] || frame.pictures.rgb;
    image.src = pictureAddress(shown.picture);
    caption.lastChild.textContent = shown === frame.pictures.rgb ? "" : `${shown.caption[0].toUpperCase()}${shown.caption.slice(1)}.`;
    boxes.replaceChildren(...(frameState.boxes ? frame.instances.flatMap(frameBoxes) : []));
    card.drawMasks();
  };
  card.loadIds = async () => {
    if (card.ids || !frame.pictures.ids) return;
    const picture = await loadPicture(frame.pictures.ids.picture);
    canvas.width = picture.naturalWidth;
    canvas.height = picture.naturalHeight;
    const pen = canvas.getContext("2d", { willReadFrequently: true, colorSpace: "srgb" });
    pen.drawImage(picture, 0, 0);
    const data = pen.getImageData(0, 0, canvas.width, canvas.height).data;
    pen.clearRect(0, 0, canvas.width, canvas.height);
    card.ids = Uint8Array.from({ length: data.length / 4 }, (_, pixel) => data[4 * pixel]);
  };
  card.drawMasks = async () => {
    if (frameState.masks || card.hovered) await card.loadIds();
    if (card.ids) paintMasks(canvas, card.ids, frame.instances, frameState.masks, card.hovered);
  };
  stage.addEventListener("pointermove", async (event) => {
    await card.loadIds();
    if (!card.ids) return;
    const place = stage.getBoundingClientRect();
    const column = Math.min(canvas.width - 1, Math.max(0, Math.floor((event.clientX - place.left) / place.width * canvas.width)));
    const row = Math.min(canvas.height - 1, Math.max(0, Math.floor((event.clientY - place.top) / place.height * canvas.height)));
    const id = card.ids[row * canvas.width + column];
    const one = frame.instances[id - 1];
    showTip(one ? `${one.name}: ${(100 * one.visible).toFixed(0)} % visible` : null, event);
    if (id !== card.hovered) { card.hovered = id; card.drawMasks(); }
  });
  stage.addEventListener("pointerleave", () => { showTip(null); card.hovered = 0; card.drawMasks(); });
  whenSeen(stage, () => { card.visible = true; card.update(); });
  return card;
}

/** Amodal box thin and dashed, visible box solid. */
function frameBoxes(one) {
  return [["amodal", 1, "4 3"], ["modal", 1.8, null]].filter(([name]) => one[name]).map(([name, thickness, dash]) => {
    const [x, y, width, height] = one[name];
    return el("svg:rect", { x, y, width, height, stroke: one.color, "stroke-width": thickness, "stroke-dasharray": dash });
  });
}

/** Fill visible masks and draw their outlines; the hovered one also when masks are off. */
function paintMasks(canvas, ids, instances, all, hovered) {
  const { width, height } = canvas;
  const pen = canvas.getContext("2d");
  const image = pen.createImageData(width, height);
  const colors = instances.map((one) => one.color.match(/\d+/g).map(Number));
  for (let row = 0, pixel = 0; row < height; row++) {
    for (let column = 0; column < width; column++, pixel++) {
      const id = ids[pixel];
      if (!id || !(all || id === hovered) || id > colors.length) continue;
      const edge = ids[pixel + 1] !== id || ids[pixel - 1] !== id || ids[pixel + width] !== id || ids[pixel - width] !== id;
      const [red, green, blue] = colors[id - 1];
      image.data.set([red, green, blue, edge ? 255 : id === hovered ? 90 : MASK_ALPHA], 4 * pixel);
    }
  }
  pen.putImageData(image, 0, 0);
}

function switchButton(label, key, name) {
  const button = el("button", { type: "button", "aria-pressed": String(frameState[name]), onclick: () => toggle() }, label);
  function toggle() {
    frameState[name] = !frameState[name];
    button.setAttribute("aria-pressed", String(frameState[name]));
    cards.forEach((card) => card.update());
  }
  return { button, toggle, key };
}

/** Dialog with one frame in large; arrow keys go on. */
function frameDialog() {
  const dialog = el("dialog", { "aria-label": "Frame" });
  let place = 0;
  function show(index) {
    if (cards.length > content.frames.length) cards.pop();
    place = (index + content.frames.length) % content.frames.length;
    const card = frameCard(content.frames[place], true);
    card.stage.style.setProperty("--ratio", card.frame.size[0] / card.frame.size[1]);
    card.stage.addEventListener("click", () => dialog.close());
    cards.push(card);
    dialog.replaceChildren(card.node, el("p", { class: "hint" }, `${place + 1} of ${content.frames.length}; arrow keys: others; Esc: close`));
    if (!dialog.open) dialog.showModal();
  }
  dialog.addEventListener("keydown", (event) => {
    const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
    if (step) { show(place + step); event.preventDefault(); }
  });
  dialog.addEventListener("close", () => { if (cards.length > content.frames.length) cards.pop(); showTip(null); });
  document.body.append(dialog);
  return show;
}

function showFrames(host) {
  if (!host || !content.frames.length) return;
  const show = frameDialog();
  const names = [...new Set(content.frames.flatMap((frame) => Object.keys(frame.pictures)))].filter((name) => name !== "ids");
  const labels = names.map((name) => [name, name === "rgb" ? "colour" : name.replace("_", " ")]);
  const base = choiceButtons("Picture", labels, (name) => { frameState.base = name; cards.forEach((card) => card.update()); });
  const masks = content.frames.some((frame) => frame.pictures.ids);
  const switches = [...(masks ? [switchButton("masks", "m", "masks")] : []), switchButton("boxes", "b", "boxes")];
  const keys = switches.map(({ key }) => el("kbd", {}, key));
  host.append(el("div", { class: "tools" }, base.group, el("div", { class: "group" }, switches.map(({ button }) => button)),
    el("span", { class: "hint" }, keys.flatMap((key, place) => [place ? " " : "", key]), " switch overlays; point at an object for its name; click to enlarge")));
  content.frames.forEach((frame, index) => {
    const card = frameCard(frame, false);
    card.stage.addEventListener("click", () => show(index));
    card.stage.addEventListener("keydown", (event) => { if (event.key === "Enter") show(index); });
    cards.push(card);
  });
  host.append(el("div", { class: "frames" }, cards.map((card) => card.node)));
  base.select("rgb");
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || /INPUT|SELECT|TEXTAREA/.test(event.target.tagName)) return;
    switches.filter(({ key }) => key === event.key).forEach(({ toggle }) => toggle());
  });
}
