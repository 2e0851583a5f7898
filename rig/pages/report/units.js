"use strict";
// Units of a report: it is written in SI, and shown in inches and pounds-force on request. A number
// is converted where a no-break space and a unit follow it, and in a column whose head ends with a
// unit.

const Units = (() => {
  const US = JSON.parse(document.getElementById("us-units").textContent);
  const switcher = document.getElementById("units");
  const NUMBER = "[\u2212+±]?\\d[\\d\u202f]*(?:\\.\\d+)?";
  const NAMES = Object.keys(US).sort((a, b) => b.length - a.length).join("|");
  const QUANTITY = new RegExp(`(${NUMBER}(?:(?: to | \u2192 |\u00a0±\u00a0)${NUMBER})*)\u00a0(${NAMES})(?![\\w/·²³^√])`, "g");
  const LEFT_OUT = "script, style, code, pre, select, .chart, .identity";
  const isUS = () => switcher.value === "US";

  const rounded = (value, decimals) => {
    const step = 10 ** Math.max(0, -decimals);
    return Charts.fixed(step > 1 ? Math.round(value / step) * step : value, decimals);
  };

  // As many digits in another unit, three at least; a value beside ± is rounded as its interval is.
  const convert = (text, factor) => {
    const more = Math.ceil(-Math.log10(factor));
    const beside = text.includes("\u00a0±\u00a0");
    const zeros = /±\u00a0[1-9][\d\u202f]*?(0*)$/.exec(text)?.[1].length ?? 0;
    return text.replace(new RegExp(NUMBER, "g"), (found) => {
      const sign = "+±".includes(found[0]) ? found[0] : "";
      const plain = found.replace(/[+±\u202f]/g, "").replace("\u2212", "-");
      const decimals = (plain.includes(".") ? plain.split(".")[1].length : -zeros) + more;
      const value = plain * factor;
      const enough = beside || value === 0 ? decimals : Math.max(decimals, 2 - Math.floor(Math.log10(Math.abs(value))));
      return sign + rounded(value, enough);
    });
  };

  const quantities = (text) => text.replace(QUANTITY, (_all, numbers, unit) => `${convert(numbers, US[unit][0])}\u00a0${US[unit][1]}`);

  const textsIn = (root) => {
    const walker = document.createTreeWalker(root, NodeFilter.SHOW_TEXT);
    const found = [];
    while (walker.nextNode()) if (!walker.currentNode.parentElement.closest(LEFT_OUT)) found.push(walker.currentNode);
    return found;
  };

  // Columns whose head ends with a unit: the unit's text, and the texts of the cells below it.
  const columnsOf = (table) => {
    const columns = [];
    let heads = [];
    for (const row of table.rows) {
      const cells = [...row.cells];
      if (row.parentElement.tagName === "THEAD") {
        heads = cells.map((cell) => (US[cell.lastChild?.data?.trim()] ? { head: cell.lastChild, unit: cell.lastChild.data.trim(), texts: [] } : null));
        columns.push(...heads.filter(Boolean));
      } else cells.forEach((cell, i) => heads[i]?.texts.push(...textsIn(cell)));
    }
    return columns;
  };

  const originals = textsIn(document.body).map((node) => [node, node.data]);
  const columns = [...document.querySelectorAll("main table")].flatMap(columnsOf);

  // A label such as "height / mm" or "velocity / (m/s)": factor and label of its axis.
  const axis = (label) => {
    const [name, unit] = label.split(" / ");
    const us = US[unit?.replace(/^\((.*)\)$/, "$1")];
    if (!isUS() || !us) return [1, label];
    return [us[0], `${name} / ${us[1].includes("/") ? `(${us[1]})` : us[1]}`];
  };

  switcher.addEventListener("change", () => {
    document.body.dataset.units = switcher.value;
    for (const [node, text] of originals) node.data = isUS() ? quantities(text) : text;
    for (const { head, unit, texts } of isUS() ? columns : []) {
      head.data = US[unit][1];
      for (const node of texts) node.data = convert(node.data, US[unit][0]);
    }
    dispatchEvent(new Event("unitschange"));
  });

  return { axis, convert, quantities };
})();
