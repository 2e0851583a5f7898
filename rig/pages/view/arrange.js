"use strict";
// How the page is arranged: tabs, menu, units, export of a chart, further charts that are kept.

const Arrange = (() => {
  const by = (id) => document.getElementById(id);
  const kept = (key, value) => {
    if (value === undefined) return JSON.parse(localStorage.getItem(`rig.${key}`) ?? "null");
    localStorage.setItem(`rig.${key}`, JSON.stringify(value));
    return value;
  };

  // --- Tabs -------------------------------------------------------------------------------------

  const tabs = [...document.querySelectorAll('[role="tab"]')];

  function open(id, { focus = false } = {}) {
    for (const tab of tabs) {
      const isOpen = tab.getAttribute("aria-controls") === id;
      tab.setAttribute("aria-selected", String(isOpen));
      tab.tabIndex = isOpen ? 0 : -1;
      by(tab.getAttribute("aria-controls")).hidden = !isOpen;
      if (isOpen && focus) tab.focus();
    }
    kept("tab", id);
    document.dispatchEvent(new Event("arranged"));
  }

  by("tabs").addEventListener("click", (event) => {
    if (event.target.role === "tab") open(event.target.getAttribute("aria-controls"));
  });
  by("tabs").addEventListener("keydown", (event) => {
    const now = tabs.findIndex((tab) => tab.getAttribute("aria-selected") === "true");
    const next = { ArrowLeft: now - 1, ArrowRight: now + 1, Home: 0, End: tabs.length - 1 }[event.key];
    if (next === undefined) return;
    event.preventDefault();
    event.stopPropagation();
    open(tabs[(next + tabs.length) % tabs.length].getAttribute("aria-controls"), { focus: true });
  });
  const isOpen = (id) => !by(id).hidden;

  // --- Menu of a narrow screen ------------------------------------------------------------------

  by("menu").addEventListener("click", () => {
    const isShown = by("tools").classList.toggle("open");
    by("menu").setAttribute("aria-expanded", String(isShown));
  });

  // --- Export -----------------------------------------------------------------------------------

  function save(content, name) {
    const link = Object.assign(document.createElement("a"), { href: URL.createObjectURL(content), download: name });
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
  }

  // `csvOf` gives the text of a chart's values, or an address at which the server has them.
  function exports(charts, nameOf, csvOf) {
    document.addEventListener("click", async (event) => {
      const kind = event.target.dataset?.export;
      if (kind === undefined) return;
      const figure = event.target.closest(".figure");
      const id = figure.dataset.chart;
      event.target.closest("details").open = false;
      if (kind === "full") await figure.requestFullscreen();
      else if (kind === "png") picture(charts[id].chart.ctx.canvas, figure).toBlob((blob) => save(blob, `${nameOf(id)}.png`));
      else save(new Blob([await csvOf(id)], { type: "text/csv" }), `${nameOf(id)}.csv`);
    });
  }

  // The chart on the page's ground, with its title and its legend.
  function picture(chart, figure) {
    const ratio = devicePixelRatio;
    const style = getComputedStyle(document.documentElement);
    const canvas = Object.assign(document.createElement("canvas"), { width: chart.width, height: chart.height + 26 * ratio });
    const ctx = canvas.getContext("2d");
    ctx.fillStyle = style.getPropertyValue("--card");
    ctx.fillRect(0, 0, canvas.width, canvas.height);
    ctx.fillStyle = style.getPropertyValue("--text");
    ctx.font = `600 ${14 * ratio}px system-ui, sans-serif`;
    const labels = [...figure.querySelectorAll(".u-series:not([hidden]) .u-label")].map((item) => item.textContent).filter((text) => text !== "t");
    ctx.fillText(`${figure.querySelector("h2").textContent}: ${labels.join(", ")}`, 8 * ratio, 18 * ratio);
    ctx.drawImage(chart, 0, 26 * ratio);
    return canvas;
  }

  return { kept, open, isOpen, exports };
})();
