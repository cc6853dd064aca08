"use strict";
// Draws the charts of a report when they come into view; all of them before it is printed.
(function () {
  const charts = JSON.parse(document.getElementById("charts").textContent);
  const dark = window.matchMedia("(prefers-color-scheme: dark)");
  const drawn = new Set();

  function themed(chart) {
    const ink = dark.matches ? "#d8dee6" : "#222", grid = dark.matches ? "#39424d" : "#e3e3e3";
    const axis = { gridcolor: grid, zerolinecolor: grid, linecolor: grid, automargin: true };
    const base = {
      paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", font: { color: ink, size: 12 },
      margin: { l: 55, r: 15, t: 10, b: 40 }, height: chart.height, hovermode: "x unified",
      hoverlabel: { bgcolor: dark.matches ? "#1c232b" : "#fff", font: { color: ink } },
      legend: { orientation: "h", y: 1.02, yanchor: "bottom", x: 0 }, showlegend: true, dragmode: "zoom",
      modebar: { bgcolor: "rgba(0,0,0,0)", color: dark.matches ? "#667" : "#bbb", activecolor: ink },
    };
    const layout = Object.assign(base, chart.layout);
    layout.xaxis = Object.assign({}, axis, chart.layout.xaxis);
    layout.yaxis = Object.assign({}, axis, chart.layout.yaxis);
    return layout;
  }

  function draw(place) {
    const chart = charts[place.dataset.chart];
    drawn.add(place);
    place.replaceChildren();
    const options = { responsive: true, displaylogo: false, modeBarButtonsToRemove: ["lasso2d", "select2d"] };
    Plotly.newPlot(place, chart.traces, themed(chart), options);
  }

  const places = Array.from(document.querySelectorAll("[data-chart]"));
  const seen = new IntersectionObserver(function (entries) {
    for (const entry of entries)
      if (entry.isIntersecting && !drawn.has(entry.target)) draw(entry.target);
  }, { rootMargin: "400px" });
  for (const place of places) seen.observe(place);
  dark.addEventListener("change", function () { for (const place of drawn) draw(place); });
  window.addEventListener("beforeprint", function () {
    for (const place of places) if (!drawn.has(place)) draw(place);
    for (const folded of document.querySelectorAll("details")) folded.open = folded.dataset.print !== "no";
  });
})();
