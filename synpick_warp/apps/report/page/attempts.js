// Attempts explained: the observation, the choice in words, the clutter graph, the ranked objects, the seal force.
"use strict";
const NODE = 17;

function showAttempts(host) {
  if (!host || !content.attempts.length) return;
  const panel = el("div", { class: "attempt" });
  const choices = content.attempts.map((attempt, index) => [index, `${attempt.episode}/${attempt.attempt} ${attempt.outcome}`]);
  const tabs = choiceButtons("Attempt", choices, (index) => showAttempt(content.attempts[index], panel));
  host.append(el("div", { class: "tools" }, tabs.group, el("span", { class: "hint" }, "episode/attempt and outcome")), panel);
  whenSeen(panel, () => tabs.select(0));
}

function showAttempt(attempt, panel) {
  const image = el("img", { class: "picture", alt: "Observation with contours and suction points", width: attempt.size[0], height: attempt.size[1], src: pictureAddress(attempt.picture) });
  const caption = `Camera 0, frame ${attempt.frame}: contours of the visible objects; ring, cross and diamond are candidates of the suction point (pole of `
    + "inaccessibility, centroid, half-way), the disc is the chosen one, and the target keeps its brightness.";
  const words = attempt.words.map((line) => {
    const cut = line.indexOf(": ");
    return el("li", {}, el("b", {}, line.slice(0, cut + 1)), line.slice(cut + 1));
  });
  const plot = el("div", { class: "plot" });
  const left = el("figure", {}, image, el("figcaption", {}, caption));
  const right = el("div", {}, el("h3", {}, `Episode ${attempt.episode}, attempt ${attempt.attempt} (${attempt.mode === "target" ? "targeted" : "untargeted"})`),
    el("p", { class: attempt.success ? "verdict success" : "verdict" }, `${attempt.sentence[0]?.toUpperCase() ?? ""}${attempt.sentence.slice(1)}.`),
    el("ul", { class: "words" }, words), attempt.objects.length ? objectTable(attempt.objects) : null);
  const force = el("figure", { class: "later" }, el("h3", {}, "Seal force"), plot, el("figcaption", {}, attempt.force
    ? "Largest force on a seal in each frame of the lift; the line is where this seal breaks." : "No force: nothing was engaged."));
  const graph = attempt.graph ? el("figure", { class: "later" }, el("h3", {}, "Clutter graph"), drawGraph(attempt.graph),
    el("figcaption", {}, "An arrow points from the object on top to the one below, with its votes; the small number counts the objects above. Dashed edges were removed.")) : null;
  panel.replaceChildren(el("div", { class: "column" }, left, force), el("div", { class: "column" }, right, graph));
  forgetPlots(".attempt");
  if (attempt.force) addPlot(plot, forceSpec(attempt.force), ".attempt");
}

function objectTable(objects) {
  const rows = objects.map((one) => {
    const dot = el("span", { class: "dot" });
    dot.style.background = one.color;
    return el("tr", { class: one.target ? "target" : "" }, el("td", {}, dot, `${one.label} ${one.name}`), el("td", { class: "num" }, String(one.above)),
      el("td", { class: "num" }, one.visible.toFixed(2)), el("td", { class: "num" }, one.pixels.toLocaleString("en")), el("td", {}, one.point));
  });
  const head = [["object", ""], ["above", "num"], ["visible", "num"], ["pixels", "num"], ["point", ""]].map(([text, kind]) => el("th", { class: kind }, text));
  return el("div", { class: "scroll" }, el("table", {}, el("thead", {}, el("tr", {}, head)), el("tbody", {}, rows)));
}

function forceSpec(force) {
  const x = { field: "time", type: "quantitative", title: "time since the suction was switched on [s]", axis: { tickCount: 8 } };
  const y = { field: "force", type: "quantitative", title: "seal force [N]", axis: { tickCount: 5 } };
  return {
    height: 190,
    layer: [
      { data: { values: [{ limit: force.limit }] }, mark: { type: "rule", strokeDash: [4, 3], color: "gray" },
        encoding: { y: { field: "limit", type: "quantitative" }, tooltip: [{ field: "limit", type: "quantitative", title: "breaks at [N]" }] } },
      { data: { values: force.values }, mark: { type: "line", point: { size: 22 } }, encoding: { x, y, tooltip: [{ field: "time", type: "quantitative", title: "time [s]" }, { field: "force", type: "quantitative", title: "seal force [N]" }] } },
    ],
  };
}

/** The clutter graph as SVG; colours of the nodes are those of the contours. */
function drawGraph(graph) {
  const [width, height] = graph.size;
  const picture = el("svg:svg", { class: "graph", viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": "Clutter graph" });
  graph.edges.forEach((edge) => picture.append(...drawEdge(edge, edge.state !== graph.kept)));
  graph.nodes.forEach((node) => {
    const [x, y] = node.place;
    if (node.target) picture.append(el("svg:circle", { cx: x, cy: y, r: NODE + 5, fill: "none", stroke: "var(--ink)", "stroke-width": 2 }));
    const [red, green, blue] = node.color.match(/\d+/g).map(Number);
    const ink = 0.3 * red + 0.6 * green + 0.1 * blue > 140 ? "#16181a" : "#ffffff";
    picture.append(el("svg:circle", { cx: x, cy: y, r: NODE, fill: node.color }), el("svg:text", { x, y, fill: ink }, node.label));
    if (node.above) {
      picture.append(el("svg:circle", { cx: x + 14, cy: y - 14, r: 8, fill: "var(--card)", stroke: "var(--soft)" }),
        el("svg:text", { x: x + 14, y: y - 13.5, fill: "var(--ink)", "font-size": 10 }, String(node.above)));
    }
  });
  return picture;
}

function drawEdge(edge, removed) {
  const points = removed ? bend(edge.points) : edge.points;
  const end = points[points.length - 1];
  const trimmed = points.filter(([x, y]) => Math.hypot(x - end[0], y - end[1]) > NODE + 9);
  if (!trimmed.length) return [];
  const from = trimmed[trimmed.length - 1];
  const angle = Math.atan2(end[1] - from[1], end[0] - from[0]);
  const top = [end[0] - (NODE + 2) * Math.cos(angle), end[1] - (NODE + 2) * Math.sin(angle)];
  const wing = (side) => [top[0] - 9 * Math.cos(angle) + side * 4 * Math.sin(angle), top[1] - 9 * Math.sin(angle) - side * 4 * Math.cos(angle)];
  const path = trimmed.map(([x, y]) => `${x},${y}`).join(" L");
  const middle = trimmed[Math.floor(0.45 * trimmed.length)];
  return [
    el("svg:path", { class: removed ? "removed" : "", d: `M${path} L${top[0]},${top[1]}` }),
    el("svg:path", { class: "tip", d: `M${top} L${wing(1)} L${wing(-1)} Z` }),
    removed ? null : el("svg:text", { class: "votes", x: middle[0], y: middle[1] }, String(edge.weight)),
  ].filter(Boolean);
}

/** A curve beside the straight line, on which the opposite edge runs. */
function bend([start, end]) {
  const control = [(start[0] + end[0]) / 2 + 0.3 * (end[1] - start[1]), (start[1] + end[1]) / 2 - 0.3 * (end[0] - start[0])];
  return Array.from({ length: 24 }, (_, step) => {
    const t = step / 23;
    return [0, 1].map((axis) => (1 - t) ** 2 * start[axis] + 2 * t * (1 - t) * control[axis] + t * t * end[axis]);
  });
}
