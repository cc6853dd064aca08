"use strict";
// Draws the charts of a report when they come into view, and all of them for printing. Timelines zoom together.
(function () {
  const text = document.getElementById("charts").textContent;
  const dark = window.matchMedia("(prefers-color-scheme: dark)");
  const places = Array.from(document.querySelectorAll("[data-chart]")), drawn = new Set();
  let content, colours, printing = false, zoom = null;

  // In the data, colours are names (colour:mode0), because they depend on the theme. Paper is light.
  function load() {
    const themes = JSON.parse(text).colours;
    colours = dark.matches && !printing ? themes.dark : themes.light;
    content = JSON.parse(text, function (_, value) {
      return typeof value === "string" && value.startsWith("colour:") ? colours[value.slice(7)] : value;
    });
  }

  function layoutOf(chart, isLarge) {
    const axis = { gridcolor: colours.grid, zerolinecolor: colours.grid, linecolor: colours.grid, automargin: true };
    const base = {
      paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", font: { color: colours.ink, size: 12 },
      margin: { l: 55, r: 15, t: 10, b: 40 }, height: chart.height, hovermode: "x unified",
      hoverlabel: { bgcolor: colours.paper, font: { color: colours.ink } },
      legend: { orientation: "h", y: 1.02, yanchor: "bottom", x: 0 }, showlegend: true, dragmode: "zoom",
      modebar: { bgcolor: "rgba(0,0,0,0)", color: colours.soft, activecolor: colours.ink },
    };
    if (printing) {  // two in a row of A4 or Letter
      Object.assign(base, { width: isLarge ? 690 : 340, height: isLarge ? 400 : 170, font: { color: colours.ink, size: 9 } });
      base.margin = { l: 40, r: 8, t: 8, b: 28 };
      base.showlegend = chart.traces.length > 1;
    }
    const layout = Object.assign(base, chart.layout);
    for (const name of ["xaxis", "yaxis"]) layout[name] = Object.assign({}, axis, chart.layout[name]);
    if (chart.timeline) {
      layout.shapes = content.shapes.concat(chart.layout.shapes || []);
      if (zoom && !printing) layout.xaxis.range = zoom.slice();
    }
    return layout;
  }

  function draw(place) {
    const chart = content.charts[place.dataset.chart];
    drawn.add(place);
    Plotly.purge(place);
    place.replaceChildren();
    const options = {
      responsive: !printing, displaylogo: false, doubleClick: "reset", displayModeBar: printing ? false : "hover",
      modeBarButtons: [["toImage", "pan2d", "zoom2d", "resetScale2d"]],  // Plotly's own list can upload the data
    };
    Plotly.newPlot(place, chart.traces, layoutOf(chart, place.classList.contains("large")), options);
    if (chart.timeline) place.on("plotly_relayout", function () { follow(place); });
  }

  function follow(source) {
    const range = source.layout.xaxis.range.slice();
    if (printing || (zoom && zoom[0] === range[0] && zoom[1] === range[1])) return;
    zoom = range;
    for (const place of drawn)
      if (place !== source && content.charts[place.dataset.chart].timeline)
        Plotly.relayout(place, { "xaxis.range": range.slice() });
  }

  function redraw(all) {
    load();
    for (const place of all) draw(place);
  }

  load();
  const seen = new IntersectionObserver(function (entries) {
    for (const entry of entries)
      if (entry.isIntersecting && !drawn.has(entry.target)) draw(entry.target);
  }, { rootMargin: "400px" });
  for (const place of places) seen.observe(place);
  dark.addEventListener("change", function () { if (!printing) redraw(Array.from(drawn)); });
  window.addEventListener("beforeprint", function () {
    printing = true;
    for (const folded of document.querySelectorAll("details")) folded.open = folded.dataset.print !== "no";
    redraw(places);
  });
  window.addEventListener("afterprint", function () { printing = false; redraw(places); });
})();
