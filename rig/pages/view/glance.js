"use strict";
// What is seen from across the bench: the banner of each run, and four tiles of present values.

const Glance = (() => {
  const by = (id) => document.getElementById(id);
  const TILES = {
    "tile-height": { plot: "height", column: "measured_height_m", colour: "--measured", decimals: { mm: 2, in: 4 } },
    "tile-force": { plot: "force", column: "force_n", colour: "--estimated", decimals: { N: 1, lbf: 2 } },
    "tile-innovation": { plot: "innovation", column: "innovation_m", colour: "--error", decimals: { mm: 3, in: 5 } },
    "tile-force-error": { plot: "force-error", column: "force_error_n", colour: "--error", decimals: { N: 1, lbf: 2 } },
  };
  const sparks = {};

  // Banners of all runs; each changes its text only where that is another one, which is then read out.
  function banners(items, ask) {
    const place = by("banners");
    while (place.children.length > items.length) place.lastChild.remove();
    items.forEach((item, i) => {
      const shown = JSON.stringify(item);
      const old = place.children[i];
      if (old?.dataset.shown === shown) return;
      const entry = document.createElement("div");
      entry.className = `banner ${item.tone}`;
      entry.dataset.shown = shown;
      const part = (tag, text, name) => Object.assign(document.createElement(tag), { textContent: text, className: name });
      if (items.length > 1) entry.append(part("span", item.name, "of"));
      const sign = part("span", item.sign, "sign");
      sign.setAttribute("aria-hidden", "true");
      entry.append(sign, part("b", item.word, "word"), part("span", item.text, "text"));
      if (item.request && item.can_ask) {
        const button = part("button", { acknowledge: "Acknowledge", arm: "Arm" }[item.request], "ask");
        button.addEventListener("click", () => ask(i, item.request));
        entry.append(button);
      }
      if (old) old.replaceWith(entry);
      else place.append(entry);
    });
  }

  function build(plots, limitsOf, unitOf) {
    for (const [id, tile] of Object.entries(TILES)) {
      sparks[id]?.destroy();
      const [factor, unit] = unitOf(plots[tile.plot].unit);
      const limits = limitsOf(tile.plot).map((value) => value * factor);
      sparks[id] = Charts.spark(by(id).querySelector(".spark"), { colour: tile.colour, limits, leastSpan: factor * plots[tile.plot].least_span });
      Object.assign(tile, { factor, unit, shown: limits });
    }
  }

  // Modes in which the model does not follow the bench: its errors say nothing.
  const APART = ["WAITING", "HOLD", "SAFE", "INIT"];

  // Values of the second before the end of what is shown; `lists` are the curves of the first run.
  function tiles(latest, mode, t, lists, begin, end) {
    const isApart = APART.includes(mode);
    const isOld = isApart && latest.measured_age_s > latest.staleAfter_s;
    const figures = {
      "tile-height": [latest.measured_height_m, latest.height_m === undefined ? "" : ["model", latest.height_m]],
      "tile-force": [latest.force_n, latest.force_std_n === undefined ? "" : ["standard deviation", latest.force_std_n]],
      "tile-innovation": [isApart ? undefined : latest.height_error_rms_m, ""],
      "tile-force-error": [isApart ? undefined : latest.force_error_rms_n, ""],
    };
    for (const [id, [value, more]] of Object.entries(figures)) {
      const tile = TILES[id];
      const figure = (v) => `${Charts.fixed(v * tile.factor, tile.decimals[tile.unit] ?? 2)} ${tile.unit}`;
      const big = value === undefined ? "–" : figure(value);
      let sub = more ? `${more[0]} ${figure(more[1])}` : "";
      if (id === "tile-force" && mode !== "RUNNING") sub = "invalid";
      if (id === "tile-height" && isOld) sub = `last value, ${Charts.fixed(latest.measured_age_s, 2)} s old`;
      if (id === "tile-force-error") {
        const share = value / latest.load_cell_peak_n;
        const without = latest.withCell ? "" : "no load cell: not known";
        sub = value === undefined ? without : Number.isFinite(share) ? `${Charts.fixed(100 * share, 1)} % of the peak force` : "";
      }
      if (id === "tile-innovation" && tile.shown.length) sub = `limit ${span(tile.shown)} ${tile.unit}`;
      put(by(id).querySelector(".big"), big);
      put(by(id).querySelector(".sub"), sub);
      by(id).classList.toggle("invalid", (id === "tile-force" && mode !== "RUNNING" && value !== undefined) || (id === "tile-height" && isOld));
      sparks[id].set([t, (lists[tile.column] ?? []).map((v) => (v === null ? null : v * tile.factor))], begin, end);
    }
  }

  // Limits, as ± where they are the same on both sides.
  function span(values) {
    const plain = (v) => Charts.number(v).replace(/(\.\d*?)0+$/, "$1").replace(/\.$/, "");
    const [low, high] = values;
    return values.length === 2 && low === -high ? `±${plain(high)}` : values.map(plain).join(" to ");
  }

  const put = (element, text) => {
    if (element.textContent !== text) element.textContent = text;
  };

  const redraw = () => Object.values(sparks).forEach((spark) => spark.redraw());
  return { banners, build, tiles, redraw, put, columns: Object.values(TILES).map((tile) => tile.column) };
})();
