"use strict";
// Draws the plots, whose numbers stand in the page in base 64: abscissae as doubles, since times are
// long, and all else as floats.
const unpacked = (text, kind = Float32Array) =>
  Array.from(new kind(Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer), (v) => (Number.isNaN(v) ? null : v));

const drawnPanels = [];
// Paper is narrower than the window: charts are drawn again at the width of its columns.
const PAPER = { whole: 690, half: 335, height: 205, low: 165 };

// Values times a factor; those that are missing stay so.
const scaled = (values, factor) => (factor === 1 ? values : values.map((v) => (v === null ? null : v * factor)));

function draw(element, original) {
  const [ofX, xLabel] = Units.axis(original.xLabel);
  const [ofY, yLabel] = Units.axis(original.yLabel);
  const panel = { ...original, xLabel, yLabel, reach: original.reach && original.reach * ofY, y_range: original.y_range && scaled(original.y_range, ofY), acting: original.acting?.map((part) => scaled(part, ofX)) };
  const x = scaled(unpacked(panel.x, Float64Array), ofX);
  const values = panel.values.map((text) => (panel.kind === "cells" ? unpacked(text) : scaled(unpacked(text), ofY)));
  const series = panel.curves.map((curve) => ({ ...curve, label: curve.name, dash: curve.dash.length ? curve.dash : undefined, dots: panel.kind === "points" && !curve.is_line, spanGaps: panel.gaps, paths: panel.steps ? Charts.steps : undefined }));
  const [name, unit] = panel.xLabel.split(" / ");
  const spec = { ...panel, series, xName: name, xUnit: unit };
  if (panel.kind === "cells") return Charts.cells(element, spec, x, scaled(unpacked(panel.y), ofY), values[0]);
  if (panel.kind === "lines") {
    const chart = Charts.lines(element, { ...spec, logX: panel.log, logY: panel.log, rangeY: panel.y_range });
    chart.set([x, ...values]);
    return chart;
  }
  const chart = Charts.plane(element, spec);
  chart.set(values.map((y) => [x, y]));
  return chart;
}

for (const data of document.querySelectorAll("script[data-plot]")) {
  const elements = document.getElementById(data.dataset.plot).querySelectorAll(".chart");
  const half = elements[0].closest(".panels2, .first") !== null;
  JSON.parse(data.textContent).forEach((panel, i) => drawnPanels.push({ half, panel, element: elements[i], ...draw(elements[i], panel) }));
}
window.addEventListener("unitschange", () => {
  for (const drawn of drawnPanels) {
    drawn.destroy();
    drawn.element.replaceChildren();
    Object.assign(drawn, draw(drawn.element, drawn.panel));
  }
});
window.addEventListener("beforeprint", () => {
  for (const folded of document.querySelectorAll("details")) folded.open = true;
  for (const { chart, half, element } of drawnPanels) {
    const height = element.classList.contains("low") ? PAPER.low : PAPER.height;
    chart.setSize({ width: half ? PAPER.half : PAPER.whole, height });
  }
});
window.addEventListener("afterprint", () => {
  for (const { chart, element } of drawnPanels) chart.setSize(Charts.sizeOf(element));
});
// A table that is wider than the screen is scrolled by keyboard too.
for (const table of document.querySelectorAll("main table")) {
  if (table.scrollWidth > table.clientWidth) table.tabIndex = 0;
}

for (const button of document.querySelectorAll("button[data-copy]")) {
  button.addEventListener("click", async () => {
    const source = document.getElementById(button.dataset.copy);
    const before = button.textContent;
    try {
      await navigator.clipboard.writeText(source.textContent);
      button.textContent = "Copied";
    } catch {
      // Without permission, as from a file: the text is selected instead.
      source.closest("details")?.setAttribute("open", "");
      getSelection().selectAllChildren(source);
      button.textContent = "Selected: copy it with Ctrl-C";
    }
    setTimeout(() => (button.textContent = before), 3000);
  });
}
