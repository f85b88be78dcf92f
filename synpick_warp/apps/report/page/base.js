// Shared parts: building elements from text that is never parsed as markup, pictures decoded when seen, scheme, navigation.
"use strict";
const SVG = "http://www.w3.org/2000/svg";
const content = JSON.parse(document.getElementById("content").textContent);

/** Create an element. Children are nodes or texts; `on...` properties are listeners, others attributes. */
function el(tag, properties, ...children) {
  const node = tag.startsWith("svg:") ? document.createElementNS(SVG, tag.slice(4)) : document.createElement(tag);
  for (const [name, value] of Object.entries(properties || {})) {
    if (name.startsWith("on")) node.addEventListener(name.slice(2), value);
    else if (value !== null && value !== undefined && value !== false) node.setAttribute(name, value === true ? "" : String(value));
  }
  node.append(...children.flat().filter((child) => child !== null && child !== undefined));
  return node;
}

/** Address of a picture of the page. */
function pictureAddress(index) {
  const store = document.getElementById(`picture-${index}`);
  return `data:image/${store.dataset.kind};base64,${store.textContent}`;
}

const loaded = new Map();
/** A decoded picture; each is decoded once. */
function loadPicture(index) {
  if (!loaded.has(index)) {
    const image = new Image();
    image.src = pictureAddress(index);
    loaded.set(index, image.decode().then(() => image));
  }
  return loaded.get(index);
}

const waiting = new Map();
const seen = new IntersectionObserver((entries) => {
  for (const entry of entries) {
    if (!entry.isIntersecting) continue;
    seen.unobserve(entry.target);
    const begin = waiting.get(entry.target);
    waiting.delete(entry.target);
    begin();
  }
}, { rootMargin: "500px 0px" });

/** Call a function once when an element comes near the window. */
function whenSeen(node, begin) {
  waiting.set(node, begin);
  seen.observe(node);
}

/** An image that is decoded when it comes near the window. */
function lazyImage(index, alt, properties) {
  const image = el("img", { alt, decoding: "async", ...properties });
  whenSeen(image, () => { image.src = pictureAddress(index); });
  return image;
}

/** Buttons of which one is chosen: [key, label] pairs; `choose` receives the key. Arrow keys move the choice. */
function choiceButtons(label, choices, choose) {
  const buttons = choices.map(([key, text]) => el("button", { type: "button", role: "tab", onclick: () => select(key) }, text));
  function select(key) {
    choices.forEach(([each], place) => {
      buttons[place].setAttribute("aria-selected", String(each === key));
      buttons[place].tabIndex = each === key ? 0 : -1;
    });
    choose(key);
  }
  const group = el("div", {
    class: "group", role: "tablist", "aria-label": label,
    onkeydown: (event) => {
      const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
      if (!step) return;
      const next = (buttons.indexOf(document.activeElement) + step + buttons.length) % buttons.length;
      buttons[next].focus();
      select(choices[next][0]);
      event.preventDefault();
    },
  }, buttons);
  return { group, select };
}

const tip = document.getElementById("tip");
/** Show a text beside the pointer; null: hide it. */
function showTip(text, event) {
  tip.hidden = text === null;
  if (text === null) return;
  tip.textContent = text;
  const right = event.clientX + 14 + tip.offsetWidth > innerWidth;
  tip.style.left = `${right ? event.clientX - 10 - tip.offsetWidth : event.clientX + 14}px`;
  tip.style.top = `${event.clientY + 14}px`;
}

const themeListeners = [];
function isDark() {
  const chosen = document.documentElement.dataset.theme;
  return chosen ? chosen === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
}
function themeChanged() {
  document.getElementById("theme").textContent = isDark() ? "Light" : "Dark";
  themeListeners.forEach((listener) => listener());
}
document.getElementById("theme").addEventListener("click", () => {
  const theme = isDark() ? "light" : "dark";
  document.documentElement.dataset.theme = theme;
  try { localStorage.setItem("synpick-report-theme", theme); } catch (error) { /* It holds until the page is closed. */ }
  themeChanged();
});
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", themeChanged);
document.getElementById("theme").textContent = isDark() ? "Light" : "Dark";

const links = [...document.querySelectorAll(".bar a")];
const places = new IntersectionObserver((entries) => {
  for (const entry of entries) {
    if (!entry.isIntersecting) continue;
    links.forEach((link) => link.toggleAttribute("aria-current", link.hash === `#${entry.target.id}`));
  }
}, { rootMargin: "-15% 0px -75% 0px" });
document.querySelectorAll("main section").forEach((section) => places.observe(section));
