// Plots by Vega-Lite, drawn when seen, in the page's colours, without code generation (Vega's expression interpreter).
"use strict";
const plots = [];

function plotConfig() {
  const style = getComputedStyle(document.documentElement);
  const color = (name) => style.getPropertyValue(name).trim();
  const font = style.getPropertyValue("--sans").trim();
  return {
    background: null,
    font,
    view: { stroke: null },
    axis: {
      labelColor: color("--soft"), titleColor: color("--soft"), titleFontWeight: "normal", gridColor: color("--line"), domainColor: color("--line"),
      tickColor: color("--line"), labelSeparation: 8, labelFlush: false, labelFontSize: 12, titleFontSize: 12, labelFont: font, titleFont: font,
    },
    axisX: { grid: true }, axisY: { grid: true }, axisDiscrete: { grid: false },
    legend: { labelColor: color("--soft"), titleColor: color("--soft"), labelFontSize: 12, titleFontSize: 12, titleFontWeight: "normal", labelFont: font, titleFont: font },
    text: { color: color("--soft"), font, fontSize: 12 },
    bar: { color: color("--accent") }, line: { color: color("--accent") }, point: { color: color("--accent"), filled: true },
    range: {
      category: [color("--accent"), color("--tint"), color("--neutral"), color("--faint"), color("--soft")],
      ramp: [color("--wash"), color("--accent")], heatmap: [color("--wash"), color("--accent")],
    },
  };
}

async function drawPlot(plot) {
  if (plot.view) plot.view.finalize();
  plot.view = null;
  const spec = { width: "container", autosize: { type: "fit-x", contains: "padding" }, ...plot.spec };
  const options = {
    mode: "vega-lite", ast: true, actions: false, renderer: "svg", defaultStyle: false, config: plotConfig(), tooltip: { disableDefaultStyle: true },
    loader: { http: { credentials: "omit" } },
  };
  plot.view = (await vegaEmbed(plot.host, spec, options)).view;
}

/** Draw a plot when it is seen. */
function addPlot(host, spec, group) {
  const plot = { host, spec, group, view: null, drawn: false };
  plots.push(plot);
  whenSeen(host, () => { plot.drawn = true; drawPlot(plot); });
}

/** Remove the plots of a group whose elements are gone. */
function forgetPlots(group) {
  for (let place = plots.length - 1; place >= 0; place--) {
    if (plots[place].group !== group) continue;
    if (plots[place].view) plots[place].view.finalize();
    plots.splice(place, 1);
  }
}

function showCharts(host) {
  if (!host) return;
  const figures = content.charts.map((chart) => {
    const plot = el("div", { class: "plot" });
    plot.style.minHeight = `${chart.spec.height > 0 ? chart.spec.height + 40 : 90}px`;
    addPlot(plot, chart.spec, "charts");
    return el("figure", { class: chart.wide ? "wide" : "", id: `chart-${chart.name}` }, el("h3", {}, chart.title), el("p", { class: "caption" }, chart.caption), plot);
  });
  host.append(el("div", { class: "charts" }, figures));
}

themeListeners.push(() => plots.filter((plot) => plot.drawn).forEach(drawPlot));
showFrames(document.getElementById("frames-host"));
showStrips(document.getElementById("strips-host"));
showAttempts(document.getElementById("attempts-host"));
showCharts(document.getElementById("charts-host"));
