"use strict";
const sources = new Map();
for (const data of document.querySelectorAll("script[data-plot]")) {
  const place = document.getElementById(data.dataset.plot);
  const figure = JSON.parse(data.textContent);
  Plotly.newPlot(place, figure.data, figure.layout, {
    responsive: true,
    displaylogo: false,
    displayModeBar: "hover",
    modeBarButtons: [["toImage", "zoom2d", "pan2d", "resetScale2d"]],
    toImageButtonOptions: { filename: data.dataset.plot },
  });
  sources.set(place, data);
}
// Paper is narrower than the window: draw again at the width of the page.
const ON_PAPER = { width: 700, "font.size": 9 };
const ON_SCREEN = { width: null, autosize: true };
window.addEventListener("beforeprint", () => {
  for (const folded of document.querySelectorAll("details")) folded.open = true;
  for (const place of sources.keys()) Plotly.relayout(place, ON_PAPER);
});
window.addEventListener("afterprint", () => {
  for (const place of sources.keys()) {
    const size = JSON.parse(sources.get(place).textContent).layout.font.size;
    Plotly.relayout(place, { ...ON_SCREEN, "font.size": size });
  }
});
