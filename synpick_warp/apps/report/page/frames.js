// Sampled frames: a base picture (colour, depth, layers), and above it visible masks, amodal masks and boxes that can be switched on.
"use strict";
const MASK_ALPHA = 130;
/** Hidden parts of amodal masks are stripes: period and width of a stripe [px], opacity. */
const STRIPE = { period: 8, width: 4, alpha: 200 };
const frameState = { base: "rgb", masks: false, amodal: false, boxes: false };
const cards = [];

function frameCaption(frame) {
  const light = frame.light ? `, light ${frame.light}` : "";
  const visible = frame.instances.filter((one) => one.visible !== 0).length;
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
  const card = { frame, node: el("figure", {}, stage, caption), stage, ids: {}, hovered: 0, visible: false };

  card.update = () => {
    if (!card.visible) return;
    const shown = frame.pictures[frameState.base] || frame.pictures.rgb;
    image.src = pictureAddress(shown.picture);
    caption.lastChild.textContent = shown === frame.pictures.rgb ? "" : `${shown.caption[0].toUpperCase()}${shown.caption.slice(1)}.`;
    boxes.replaceChildren(...(frameState.boxes ? frame.instances.flatMap(frameBoxes) : []));
    card.drawMasks();
  };
  card.loadIds = async (name) => {
    if (card.ids[name] || !frame.pictures[name]) return;
    const read = await readIds(frame.pictures[name].picture);
    card.ids[name] = read.ids;
    if (name !== "ids") return;
    canvas.width = read.width;
    canvas.height = read.height;
  };
  card.drawMasks = async () => {
    if (frameState.masks || frameState.amodal || card.hovered) await card.loadIds("ids");
    if (frameState.amodal) await card.loadIds("amodal");
    if (!card.ids.ids) return;
    const pen = canvas.getContext("2d", { willReadFrequently: true });
    const image = pen.createImageData(canvas.width, canvas.height);
    paintMasks(image, card.ids.ids, frame.instances, frameState.masks, card.hovered);
    if (frameState.amodal && card.ids.amodal) paintAmodal(image, card.ids, frame.instances);
    pen.putImageData(image, 0, 0);
  };
  stage.addEventListener("pointermove", async (event) => {
    await card.loadIds("ids");
    if (!card.ids.ids) return;
    const place = stage.getBoundingClientRect();
    const column = Math.min(canvas.width - 1, Math.max(0, Math.floor((event.clientX - place.left) / place.width * canvas.width)));
    const row = Math.min(canvas.height - 1, Math.max(0, Math.floor((event.clientY - place.top) / place.height * canvas.height)));
    const id = card.ids.ids[row * canvas.width + column];
    const one = frame.instances[id - 1];
    showTip(one && (one.visible === null ? one.name : `${one.name}: ${(100 * one.visible).toFixed(0)} % visible`), event);
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

/** Ids of a picture's pixels, which are its grey levels. */
async function readIds(place) {
  const picture = await loadPicture(place);
  const scratch = el("canvas");
  const { naturalWidth: width, naturalHeight: height } = picture;
  Object.assign(scratch, { width, height });
  const pen = scratch.getContext("2d", { willReadFrequently: true, colorSpace: "srgb" });
  pen.drawImage(picture, 0, 0);
  const data = pen.getImageData(0, 0, width, height).data;
  return { width, height, ids: Uint8Array.from({ length: width * height }, (_, pixel) => data[4 * pixel]) };
}

const colorsOf = (instances) => instances.map((one) => one.color.match(/\d+/g).map(Number));

/** Whether a pixel has a neighbour of another id. */
function isEdge(ids, pixel, width) {
  const id = ids[pixel];
  return ids[pixel + 1] !== id || ids[pixel - 1] !== id || ids[pixel + width] !== id || ids[pixel - width] !== id;
}

/** Fill visible masks and draw their outlines; the hovered one also when masks are off. */
function paintMasks(image, ids, instances, all, hovered) {
  const colors = colorsOf(instances);
  for (let pixel = 0; pixel < ids.length; pixel++) {
    const id = ids[pixel];
    if (!id || !(all || id === hovered) || id > colors.length) continue;
    const alpha = isEdge(ids, pixel, image.width) ? 255 : id === hovered ? 90 : MASK_ALPHA;
    image.data.set([...colors[id - 1], alpha], 4 * pixel);
  }
}

/** Draw outlines of amodal masks and stripes on their hidden parts; silhouettes overlap, so they come in planes below each other. */
function paintAmodal(image, { ids, amodal }, instances) {
  const colors = colorsOf(instances), size = ids.length;
  for (let first = 0; first < amodal.length; first += size) {
    const plane = amodal.subarray(first, first + size);
    for (let pixel = 0; pixel < size; pixel++) {
      const id = plane[pixel];
      if (!id || id > colors.length) continue;
      const edge = isEdge(plane, pixel, image.width);
      const diagonal = pixel % image.width + Math.floor(pixel / image.width);
      if (edge || (ids[pixel] !== id && diagonal % STRIPE.period < STRIPE.width)) {
        image.data.set([...colors[id - 1], edge ? 255 : STRIPE.alpha], 4 * pixel);
      }
    }
  }
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
  const names = [...new Set(content.frames.flatMap((frame) => Object.keys(frame.pictures)))].filter((name) => !["ids", "amodal"].includes(name));
  const labels = names.map((name) => [name, name === "rgb" ? "colour" : name.replace("_", " ")]);
  const base = choiceButtons("Picture", labels, (name) => { frameState.base = name; cards.forEach((card) => card.update()); });
  const has = (name) => content.frames.some((frame) => frame.pictures[name]);
  const switches = [...(has("ids") ? [switchButton("masks", "m", "masks")] : []),
    ...(has("amodal") ? [switchButton("amodal masks", "a", "amodal")] : []), switchButton("boxes", "b", "boxes")];
  const keys = switches.map(({ key }) => el("kbd", {}, key));
  host.append(el("div", { class: "tools" }, base.group, el("div", { class: "group" }, switches.map(({ button }) => button)),
    el("span", { class: "hint" }, keys.flatMap((key, place) => [place ? " " : "", key]), " switch overlays; stripes: hidden parts; point at an object for its name; click to enlarge")));
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
