"use strict";
// The page requests the visible stretch, draws it, and requests again: a slow page only draws less
// often. All data come from the server; the page keeps only the data on the screen.

const FRAME_MS = 80;
const SLOWLY_MS = 240; // tiles, modes and faults: nobody reads them faster
const CLOSELY_MS = 1000;
const RUNS_MS = 1000;
const HIDDEN_MS = 1000;
const COLOURS = ["--estimated", "--second", "--law", "--fourth"];
const OF_ORIGIN = { measured: "--measured", model: "--estimated", estimated: "--estimated", observer: "--virtual", error: "--error" };
const DASHES = [[3, 3], [8, 3, 2, 3], [2, 5], [12, 4]];
const WORDS = { live: "recording", done: "ended", safe: "ended", waiting: "ended", failed: "ended" };

const at = (id) => document.getElementById(id);
// The server's table of plots: columns, quantities and units.
const TABLE = JSON.parse(at("table").textContent);
const charts = {};
let runs = [];
let shape = ""; // what the charts were made for
let strut = "";
let added = Arrange.kept("added") ?? []; // columns of further charts
let units = Arrange.kept("units") ?? "SI";
// `follow`: the end is the newest cycle. `span` is a length in s, or null for the whole run.
const view = { begin: 0, end: 10, span: 10, follow: true };
let changed = true;
let drawnAt = -Infinity; // when tiles and modes were drawn
let evaluatedKey = "";
let begun = []; // what was drawn last: columns of the chart that is exported

async function ask(path, given = {}) {
  const answer = await fetch(`${path}?${new URLSearchParams(given)}`);
  if (!answer.ok) throw new Error(await answer.text());
  return answer;
}

// Factor and name of the unit in which a quantity in SI is shown.
const unitOf = (unit) => TABLE.units[units][unit] ?? [1, unit];
const labelOf = ({ name, unit }) => {
  const shown = unitOf(unit)[1];
  return `${name} / ${shown.includes("/") ? `(${shown})` : shown}`;
};

const columnsOf = (name) => [
  ...TABLE.curves.map((curve) => (curve.is_of_strut ? `${name}.${curve.column}` : curve.column)),
  ...TABLE.band.columns,
  ...added,
];

// Whether the newest cycles are requested, at any time.
const isFollowing = () => view.follow && runs.length === 1 && view.span !== null;

// A stretch as plain lists: uPlot takes null for nothing.
async function stretch(index, points) {
  const columns = columnsOf(strut);
  const [begin_s, end_s] = isFollowing() ? [0, view.span] : [view.begin, view.end];
  const given = { run: index, begin: begin_s, end: end_s, points, columns: columns.join(","), strut };
  if (isFollowing()) given.follow = 1;
  const content = await (await ask("stretch", given)).arrayBuffer();
  const length = new DataView(content).getUint32(0, true);
  const head = JSON.parse(new TextDecoder().decode(new Uint8Array(content, 4, length)));
  const begin = 4 + length;
  const t = Array.from(new Float64Array(content, begin, head.count));
  const values = new Float32Array(content, begin + 8 * head.count);
  const lists = columns.map((_name, i) => {
    const list = new Array(head.count);
    for (let k = 0; k < head.count; k++) {
      const value = values[i * head.count + k];
      list[k] = Number.isNaN(value) ? null : value;
    }
    return list;
  });
  return { head, t, lists };
}

// A label, with its run's name where there are several.
const named = (index, text) => (runs.length > 1 ? `${runs[index].name}: ${text}` : text);

// Whether a run has a curve: a column that the bench has once is that of a strut only if the model
// has one strut.
const has = (run, curve) => curve.is_of_strut || (run.struts.length === 1 && run.columns.includes(curve.column));

// Series of each chart over time: the number of a column, its scale and its look.
function seriesOf(several) {
  const series = Object.fromEntries(Object.keys(TABLE.plots).map((key) => [key, []]));
  runs.forEach((run, index) => {
    TABLE.curves.forEach((curve, column) => {
      if (!has(run, curve)) return;
      const [factor, unit] = unitOf(TABLE.plots[curve.plot].unit);
      const isMeasured = curve.origin === "measured";
      const colour = several ? COLOURS[index % 4] : OF_ORIGIN[curve.origin];
      const look = several && isMeasured ? { dash: [5, 4], width: 1 } : { width: isMeasured ? 2 : 1.4 };
      // Where the load cell has a sample, and where the runs' cycles do not coincide.
      const spanGaps = several || isMeasured || curve.origin === "error";
      series[curve.plot].push({ run: index, column, factor, unit, colour, spanGaps, label: named(index, curve.label), ...look });
    });
  });
  const first = TABLE.curves.length + TABLE.band.columns.length;
  added.forEach((column, i) => {
    const [, , si] = splitColumn(column);
    const [factor, unit] = unitOf(si);
    series[`more-${i}`] = runs.map((_run, index) => ({ run: index, column: first + i, factor, unit, colour: COLOURS[index % 4], spanGaps: true, width: 1.4, label: named(index, column) }));
  });
  return series;
}

const SUFFIXES = [["_m_per_s2", "m/s²"], ["_m_per_s", "m/s"], ["_n_per_s", "N/s"], ["_mbar", "mbar"], ["_ns", "ns"], ["_m", "m"], ["_n", "N"], ["_c", "°C"], ["_s", "s"], ["_hz", "Hz"]];

// Name, strut or empty, and SI unit of a column of the log.
function splitColumn(column) {
  const [owner, name] = column.includes(".") ? column.split(/\.(.*)/s) : ["", column];
  const [suffix, unit] = SUFFIXES.find(([end]) => name.endsWith(end)) ?? ["", ""];
  return [name.slice(0, name.length - suffix.length).replaceAll("_", " "), owner, unit];
}

// Limits of the configuration on some quantities of the strut that is shown.
function limitsOf(values) {
  const rows = runs[0]?.supervision?.limits ?? [];
  return rows
    .filter((row) => values.includes(row.value) && !row.channel && (!row.strut || row.strut === strut))
    .flatMap((row) => [row.low, row.high])
    .filter((value) => typeof value === "number");
}

let shown = {};

function build() {
  evaluatedKey = "";
  for (const [id, chart] of Object.entries(charts)) {
    chart.destroy();
    delete charts[id];
  }
  const several = runs.length > 1;
  placeAdded();
  shown = seriesOf(several);
  const common = { sync: "t", xName: "t", xUnit: TABLE.time_unit, onSelect: look, onReset: newest };
  const over = (id, quantity, more = {}) => {
    const [factor, unit] = unitOf(quantity.unit);
    const limits = limitsOf(LIMITED[id] ?? []).map((value) => value * factor);
    charts[id] = Charts.lines(at(id), { ...common, yLabel: unit, series: shown[id], leastSpan: factor * quantity.least_span, limits, ...more });
  };
  const bare = { xAxis: { size: 6, values: () => [], label: null, ticks: { show: false } } };
  for (const [id, quantity] of Object.entries(TABLE.plots)) {
    at(id).closest(".figure").hidden = shown[id].length === 0;
    over(id, quantity, id === "virtual" ? {} : { ...bare, yAxis: { space: quantity.is_strip ? 18 : 30 } });
  }
  added.forEach((column, i) => over(`more-${i}`, { unit: splitColumn(column)[2], least_span: 0 }));
  const [mode, ...faults] = TABLE.band.columns.map((_name, i) => TABLE.curves.length + i);
  shown.band = runs.flatMap((_run, run) => [mode, ...faults].map((column) => ({ run, column, factor: 1, label: "", colour: "--text" })));
  const each = TABLE.band.columns.length;
  charts.band = Charts.band(at("band"), {
    ...common, xLabel: "time / s", yLabel: "", series: shown.band, modes: TABLE.band.modes,
    lanes: runs.map((_run, i) => ({ mode: 1 + i * each, faults: faults.map((_fault, k) => 2 + i * each + k) })),
  });
  const { planes, spectrum, ticks } = TABLE;
  const points = runs.flatMap((_run, i) => {
    const colour = several ? COLOURS[i % 4] : "--estimated";
    return [
      { label: named(i, planes.estimated), colour, dots: true, faint: true },
      { label: named(i, planes.measured), colour: "--measured", dots: true },
      { label: named(i, "last cycle"), colour, width: 2.4 },
    ];
  });
  const laws = runs.map((_run, i) => ({ label: named(i, "law"), colour: several ? COLOURS[i % 4] : "--law", dash: [8, 4] }));
  const others = runs[0].models.map((name, i) => ({ label: `law of ${name}`, colour: "--fourth", dash: DASHES[i % 4] }));
  for (const quantity of Object.values(planes.motions)) {
    const leastX = unitOf(quantity.unit)[0] * quantity.least_span;
    charts[`plane-${quantity.name}`] = Charts.plane(at(`plane-${quantity.name}`), {
      xLabel: labelOf(quantity), yLabel: unitOf(planes.force.unit)[1], leastX, leastY: unitOf(planes.force.unit)[0] * planes.force.least_span, series: [...points, ...laws, ...others],
    });
  }
  const density = unitOf("N/√Hz")[1];
  charts.spectrum = Charts.lines(at("spectrum"), {
    xLabel: labelOf(spectrum.frequency), xName: spectrum.frequency.name, xUnit: spectrum.frequency.unit, yLabel: density, logX: true, logY: true, rangeY: Charts.decades,
    series: runs.map((run, i) => ({ label: several ? run.name : spectrum.label, unit: density, colour: several ? COLOURS[i % 4] : "--virtual", spanGaps: true })),
  });
  charts.timing = Charts.lines(at("timing"), {
    xLabel: ticks.time, xName: "from", xUnit: ticks.time_unit, yLabel: "ticks", logX: true, logY: true,
    series: ticks.curves.map((label, i) => ({ label, colour: ["--virtual", "--estimated"][i], paths: Charts.steps })),
  });
  Glance.build(TABLE.plots, (plot) => limitsOf(LIMITED[plot]), unitOf);
}

const LIMITED = { height: ["measured_height_m", "height_m"], force: ["force_n"], innovation: ["innovation_m"], "force-error": ["force_difference_n"], virtual: ["virtual_force_n"] };

// Whether a chart is looked at: those behind a tab cost nothing.
const isSeen = (id) => at(id).offsetParent !== null || document.fullscreenElement?.contains(at(id));

function draw(found) {
  const [first] = found;
  if (isFollowing()) {
    view.end = first.head.end_s;
    view.begin = Math.max(view.end - view.span, first.head.span_s[0]);
    if (view.end <= view.begin) view.end = view.begin + 1e-3;
  }
  found.forEach((item, i) => {
    runs[i].span_s = item.head.span_s;
    runs[i].state = item.head.state;
    runs[i].banner = item.head.banner;
  });
  banners();
  // A long run is read piece by piece: the whole of it is longer the next time.
  if (view.follow && last() > view.end + 1e-6) changed = true;
  const names = columnsOf(strut);
  const width = names.length;
  const t = found.length === 1 ? [first.t, ...first.lists] : uPlot.join(found.map((item) => [item.t, ...item.lists]));
  begun = [width, t];
  const isSlow = !isFollowing() || first.head.state !== "live" || performance.now() - drawnAt >= SLOWLY_MS;
  if (isSlow) drawnAt = performance.now();
  // All are asked before the first is drawn: an answer after a change has the page laid out again.
  for (const id of Object.keys(shown).filter((id) => (isSlow || id !== "band") && isSeen(id))) {
    const lists = shown[id].map((item) => {
      const list = t[1 + item.run * width + item.column];
      return item.factor === 1 ? list : list.map((v) => (v === null || v === undefined ? null : item.factor * v));
    });
    const lastOf = (item) => found[item.run].head.last[names[item.column]];
    charts[id].chart.latest = [null, ...shown[id].map((item) => (lastOf(item) === undefined ? null : lastOf(item) * item.factor))];
    charts[id].set([t[0], ...lists], view.begin, view.end);
  }
  if (isSlow) tiles(first);
  const steps = found.reduce((sum, item) => sum + item.head.steps, 0);
  at("shown").textContent = `${view.begin.toFixed(2)} to ${view.end.toFixed(2)} s, ${Charts.fixed(steps, 0)} ticks`;
  document.body.dataset.end = first.head.span_s[1];
  document.body.dataset.frames = Number(document.body.dataset.frames ?? 0) + 1;
}

function tiles({ head, t, lists }) {
  const curves = Object.fromEntries(TABLE.curves.map((curve, i) => [curve.column, has(runs[0], curve) ? lists[i] : []]));
  const withCell = runs[0].columns.includes("force_error_n");
  const staleAfter_s = runs[0].supervision?.stale_after_s ?? Infinity;
  Glance.tiles({ ...head.latest, withCell, staleAfter_s }, TABLE.band.modes[head.latest.mode]?.[0], t, curves, view.begin, view.end);
}

function banners() {
  const items = runs.map((run) => ({ ...run.banner, name: run.name, can_ask: token !== "" && run.state === "live" }));
  Glance.banners(items, (run, request) => demand("set", run, { request }));
}

async function evaluateStretch() {
  const key = [view.begin, view.end, strut, units].join();
  if (document.hidden || shape === "" || key === evaluatedKey) return;
  const given = { begin: view.begin, end: view.end, strut };
  const found = await Promise.all(runs.map(async (_run, run) => (await ask("closely", { run, ...given })).json()));
  const force = unitOf(TABLE.planes.force.unit)[0];
  for (const [id, quantity] of Object.entries(TABLE.planes.motions)) {
    const motion = unitOf(quantity.unit)[0];
    const scaled = ([xs, ys]) => [xs.map((x) => x * motion), ys.map((y) => y * force)];
    const points = found.flatMap((item) => ["estimated", "measured", "recent"].map((kind) => scaled(item.planes[`${id}:${kind}`])));
    const own = found.map((item) => scaled(item.laws.model?.[id] ?? [[], []]));
    const others = runs[0].models.map((name) => scaled(found[0].laws[name]?.[id] ?? [[], []]));
    charts[`plane-${quantity.name}`].set([...points, ...own, ...others]);
  }
  const scale = unitOf("N/√Hz")[0];
  const spectra = found.map((item) => [item.spectrum.frequency_hz, item.spectrum.density.map((v) => v * scale)]);
  if (isSeen("spectrum")) charts.spectrum.set(spectra.length === 1 ? spectra[0] : uPlot.join(spectra));
  const timing = found[0].timing;
  at("timing").closest("section").hidden = !timing;
  at("no-timing").hidden = Boolean(timing);
  if (timing && isSeen("timing")) {
    const some = (list) => list.map((v) => (v > 0 ? v : null));
    charts.timing.set([timing.edges_us.map((v) => Math.max(v, 0.5)), ...TABLE.ticks.curves.map((name) => some(timing[name]))]);
  }
  at("longest").textContent = found[0].longest_s;
  figures(found);
  events(found);
  evaluatedKey = key;
}

function figures(found) {
  const rows = [];
  found.forEach((item, i) => {
    const name = runs.length > 1 ? `${runs[i].name}: ` : "";
    if (item.bus.load !== undefined) {
      rows.push([`${name}bus load`, `${Charts.fixed(100 * item.bus.load, 1)} %`]);
      rows.push([`${name}frames`, `${Charts.fixed(item.bus.frames_per_s, 0)} /s`]);
    }
    if (item.timing) rows.push([`${name}longest gap`, `${Charts.fixed(item.timing.longest_gap_us / 1000, 2)} ms`]);
    const counts = Object.entries(runs[i].counts ?? {}).filter(([key, value]) => value > 0 && key !== "started");
    for (const [key, value] of counts) rows.push([`${name}${TABLE.counts[key] ?? key.replaceAll("_", " ")}`, Charts.fixed(value, 0)]);
    if (runs[i].counts && counts.length === 0) rows.push([`${name}faults`, "no faults"]);
    if (runs[i].diverged) rows.push([`${name}diverged`, `${runs[i].diverged.strut}, ${runs[i].diverged.t_s.toFixed(3)} s`]);
  });
  at("figures").replaceChildren(
    ...rows.map(([name, value]) => {
      const pair = document.createElement("div");
      pair.append(Object.assign(document.createElement("dt"), { textContent: name }), Object.assign(document.createElement("dd"), { textContent: value }));
      return pair;
    }),
  );
}

// Events of the runs, the newest first; a click shows the second about one.
function events(found) {
  const items = found.flatMap((item, i) => item.events.map((event) => ({ ...event, run: i }))).sort((a, b) => b.t_s - a.t_s);
  const asked = JSON.stringify(items);
  if (at("events").dataset.asked === asked) return;
  at("events").dataset.asked = asked;
  at("events").replaceChildren(...items.map((event) => {
    const entry = document.createElement("li");
    const button = Object.assign(document.createElement("button"), { textContent: eventText(event) });
    button.addEventListener("click", () => showEvent(event));
    entry.append(button);
    return entry;
  }));
  at("events").events = items;
}

const eventText = ({ t_s, run, what, why }) => `${t_s.toFixed(3)} s  ${named(run, what)}${why ? `: ${why}` : ""}`;

function showEvent(event) {
  const { t_s } = event;
  at("event").textContent = eventText(event);
  look(Math.max(0, t_s - 0.5), t_s + 0.5);
}

// A click into the band shows the event next to it.
at("band").addEventListener("click", (event) => {
  const chart = charts.band?.chart;
  if (!chart) return;
  const x = event.clientX - chart.over.getBoundingClientRect().left;
  const near = [...(at("events").events ?? [])].map((item) => [Math.abs(chart.valToPos(item.t_s, "x") - x), item]).sort((a, b) => a[0] - b[0])[0];
  if (near && near[0] < 8) showEvent(near[1]);
});

// --- Further charts, export, second cursor, link --------------------------------------------------

function placeAdded() {
  added = added.filter((column) => runs.some((run) => run.columns.includes(column)));
  at("added").replaceChildren(...added.map((column, i) => {
    const copy = at("force").closest(".figure").cloneNode(true);
    copy.dataset.chart = `more-${i}`;
    copy.hidden = false;
    copy.querySelector("h2").textContent = column;
    const chart = copy.querySelector(".chart");
    chart.replaceChildren();
    copy.querySelector(".legend").replaceChildren();
    chart.id = `more-${i}`;
    chart.setAttribute("aria-label", `${column} over time`);
    const remove = Object.assign(document.createElement("button"), { textContent: "✕", className: "remove" });
    remove.setAttribute("aria-label", `Remove the chart of ${column}`);
    remove.addEventListener("click", () => arrangeAdded(added.filter((name) => name !== column)));
    copy.querySelector(".head").append(remove);
    return copy;
  }));
  const names = [...new Set(runs.flatMap((run) => run.columns))].filter((name) => !["t_ns", ...added].includes(name));
  at("quantity").replaceChildren(...names.map((name) => new Option(name, name)));
}

function arrangeAdded(columns) {
  added = Arrange.kept("added", columns);
  build();
  update();
}

at("add").addEventListener("submit", (event) => {
  event.preventDefault();
  if (at("quantity").value) arrangeAdded([...added, at("quantity").value]);
});

// Every cycle of what is shown, from the server; of a spectrum or plane what is drawn.
async function csvOf(id) {
  const columns = (shown[id] ?? []).filter((item) => item.run === 0).map((item) => columnsOf(strut)[item.column]);
  if (columns.length) return (await ask("csv", { run: 0, begin: view.begin, end: view.end, columns: columns.join(",") })).text();
  const { chart } = charts[id];
  const { series, data } = chart;
  if (chart.mode === 2) return data.slice(1).flatMap((pair, i) => pair[0].map((x, k) => [`"${series[i + 1].label}"`, x, pair[1][k]].join())).join("\n");
  const rows = data[0].map((_x, k) => data.map((list) => list[k] ?? "").join());
  return [series.map((item) => `"${item.label}"`).join(), ...rows].join("\n");
}

Arrange.exports(charts, (id) => `${runs.map((run) => run.name).join("-")}-${id}`, csvOf);

function setReference() {
  const { left } = charts.height.chart.cursor;
  const middle = 0.5 * (view.begin + view.end);
  Charts.reference.x = Charts.reference.x !== null ? null : left >= 0 ? charts.height.chart.posToVal(left, "x") : middle;
  const isSet = Charts.reference.x !== null;
  at("reference").setAttribute("aria-pressed", String(isSet));
  at("reference").textContent = isSet ? `Δ from ${Charts.reference.x.toFixed(3)} s` : "Δ cursor";
  update();
}

at("reference").addEventListener("click", setReference);
at("link").addEventListener("click", async () => {
  const shownNow = new URLSearchParams({ begin: view.begin.toFixed(6), end: view.end.toFixed(6), strut, units });
  history.replaceState(null, "", `?${shownNow}${location.hash}`);
  await navigator.clipboard?.writeText(location.href.split("#")[0]);
  at("link").textContent = "Copied";
  setTimeout(() => (at("link").textContent = "Link"), 1500);
});
at("units").value = units;
at("units").addEventListener("change", () => {
  units = Arrange.kept("units", at("units").value);
  build();
  update();
});
document.addEventListener("arranged", () => {
  evaluatedKey = "";
  changed = true;
});
document.addEventListener("fullscreenchange", () => Object.values(charts).forEach((chart) => chart.chart.setSize(Charts.sizeOf(chart.chart.root.parentElement))));

// What a link asks for, once.
function takeLink() {
  const given = new URLSearchParams(location.search);
  if (given.has("strut") && [...at("strut").options].some((option) => option.value === given.get("strut"))) strut = at("strut").value = given.get("strut");
  if (TABLE.units[given.get("units")]) units = at("units").value = given.get("units");
  const [begin, end] = ["begin", "end"].map((name) => Number(given.get(name)));
  return given.has("begin") && end > begin ? [begin, end] : null;
}

// --- The visible stretch ---------------------------------------------------------------------

const last = () => Math.max(0, ...runs.map((run) => run.span_s[1]));

function look(begin, end) {
  const least = 1e-3;
  if (end - begin < least) end = begin + least;
  Object.assign(view, { begin, end, span: end - begin, follow: false });
  update();
}

function follow(span) {
  Object.assign(view, { span, follow: true, end: last(), begin: span === null ? 0 : last() - span });
  update();
}

const newest = () => follow(at("span").value === "whole" ? null : Number(at("span").value));

function move(share) {
  const by = share * (view.end - view.begin);
  look(view.begin + by, view.end + by);
}

function zoom(factor) {
  const middle = view.follow ? view.end : 0.5 * (view.begin + view.end);
  const half = 0.5 * factor * (view.end - view.begin);
  if (view.follow) follow(2 * half);
  else look(middle - half, middle + half);
}

function pause() {
  if (view.follow) look(view.begin, view.end);
  else newest();
}

function update() {
  changed = true;
  at("pause").setAttribute("aria-pressed", String(!view.follow));
  at("pause").textContent = view.follow ? "Pause" : "Resume";
}

// --- Changes of a live run ---------------------------------------------------------------------

const token = decodeURIComponent(location.hash.slice(1));

function control() {
  const live = runs.findIndex((run) => run.state === "live");
  at("control").hidden = token === "" || live < 0;
  at("no-control").hidden = !at("control").hidden;
  at("control-of").textContent = runs.length > 1 && live >= 0 ? `Control of ${runs[live].name}` : "Control";
  const { observers, supervision } = runs[Math.max(live, 0)];
  const keys = [...numbers("observers", observers), ...numbers("supervision", supervision)];
  const asked = JSON.stringify([live, keys]);
  if (at("key").dataset.asked === asked) return;
  at("key").dataset.asked = asked;
  at("key").replaceChildren(...keys.map(([key, value]) => new Option(`${key} (${value} at the start)`, key)));
}

// Keys and values of all numbers in a section; null is a limit that is not set. A filter cannot be
// changed during a run.
function numbers(key, value) {
  if (value === null || typeof value === "number") return [[key, value ?? "none"]];
  if (typeof value !== "object") return [];
  return Object.entries(value).filter(([name]) => name !== "filter").flatMap(([name, item]) => numbers(`${key}.${name}`, item));
}

async function demand(action, run, content) {
  const options = { method: "POST", headers: { "X-Rig-Token": token, "Content-Type": "application/json" }, body: JSON.stringify(content) };
  try {
    const answer = await fetch(`${action}?run=${run}`, options);
    return answer.ok ? await answer.json() : { error: await answer.text() };
  } catch {
    return { error: "No answer from rig view." };
  }
}

async function change(content) {
  const found = await demand("set", runs.findIndex((item) => item.state === "live"), content);
  at("answer").className = found.error ? "bad" : "good";
  at("answer").textContent = found.error ?? (found.marked ? `Marked: ${found.marked}.` : found.requested ? `Requested: ${found.requested}.` : `Changed from ${(found.t_ns * 1e-9).toFixed(3)} s on.`);
}

at("change").addEventListener("submit", (event) => {
  event.preventDefault();
  const value = Number(at("value").value);
  if (at("value").value.trim() === "" || Number.isNaN(value)) {
    at("answer").className = "bad";
    at("answer").textContent = "Value: expected a number.";
    return;
  }
  change({ set: { [at("key").value]: value } });
});
at("mark").addEventListener("submit", (event) => {
  event.preventDefault();
  change({ mark: at("mark-text").value });
});
for (const request of ["acknowledge", "arm", "disarm"]) {
  at(request).addEventListener("click", () => change({ request }));
}

// --- The diagnosis of a finished run -----------------------------------------------------------

const FINISHED = ["done", "safe", "waiting", "failed", "killed"];
const diagnosed = () => Number(at("diagnosed").value);

function offerDiagnosis() {
  const finished = runs.map((run, i) => [run, i]).filter(([run]) => FINISHED.includes(run.state) && run.steps > 0);
  const asked = JSON.stringify([finished.map(([run, i]) => [run.name, i]), runs[0].models]);
  if (at("diagnosis").dataset.asked === asked) return;
  at("diagnosis").dataset.asked = asked;
  const before = at("diagnosed").value;
  at("diagnosed").replaceChildren(...finished.map(([run, i]) => new Option(run.name, i)));
  if (finished.some(([, i]) => String(i) === before)) at("diagnosed").value = before;
  at("nominal").replaceChildren(new Option("as it ran", ""), ...runs[0].models.map((name) => new Option(name, name)));
  at("nominal-label").hidden = runs[0].models.length === 0;
  at("diagnosed").closest("label").hidden = finished.length < 2;
  offerHeldOut();
}

// Every other finished run may be held out: the model is evaluated on it, and not fitted to it.
function offerHeldOut() {
  const others = [...at("diagnosed").options].filter((option) => Number(option.value) !== diagnosed());
  at("held-out").replaceChildren(...others.map((option) => {
    const label = document.createElement("label");
    const box = Object.assign(document.createElement("input"), { type: "checkbox", value: option.value });
    label.append(box, ` held out: ${option.text}`);
    return label;
  }));
}

async function readDiagnosis() {
  if (runs.length === 0) return;
  offerDiagnosis();
  const none = at("diagnosed").options.length === 0;
  const found = none ? { state: "none" } : await (await ask("diagnosis", { run: diagnosed() })).json();
  at("diagnosis").hidden = none || (token === "" && found.state === "none");
  at("no-diagnosis").hidden = !at("diagnosis").hidden;
  const running = found.state === "running";
  at("start").hidden = token === "" || running;
  at("cancel").hidden = token === "" || !running;
  at("progress-of").hidden = !running;
  at("progress").value = found.share ?? 0;
  at("doing").textContent = running ? `${Math.round(100 * found.share)} %, ${found.stage}` : "";
  const words = { done: `Verdict: ${found.verdict}.`, failed: `It failed: ${found.why}`, cancelled: "Cancelled." };
  if (found.state !== "none") at("outcome").textContent = words[found.state] ?? "";
  at("outcome").className = found.state === "failed" ? "bad" : "";
  at("report-of").hidden = found.state !== "done";
  at("report").href = `report?run=${diagnosed()}`;
  at("report-folder").textContent = found.folder ?? "";
}

at("diagnosed").addEventListener("change", offerHeldOut);
at("diagnose").addEventListener("submit", async (event) => {
  event.preventDefault();
  const held_out = [...at("held-out").querySelectorAll("input:checked")].map((box) => Number(box.value));
  const found = await demand("diagnose", diagnosed(), { held_out, model: at("nominal").value });
  at("outcome").className = found.error ? "bad" : "";
  at("outcome").textContent = found.error ?? "";
});
at("cancel").addEventListener("click", () => demand("cancel", diagnosed(), {}));

// --- The runs --------------------------------------------------------------------------------

async function readRuns() {
  runs = await (await ask("runs")).json();
  const list = runs.map((run, i) => {
    const entry = document.createElement("div");
    entry.className = "run";
    const name = Object.assign(document.createElement("b"), { textContent: run.name, title: run.folder });
    const pill = Object.assign(document.createElement("span"), { textContent: WORDS[run.state] ?? run.state, title: run.words, className: "pill quiet" });
    const about = Object.assign(document.createElement("span"), { className: "quiet", textContent: [run.model, run.rate_hz ? `${run.rate_hz} Hz` : ""].filter(Boolean).join(", ") });
    if (runs.length > 1) entry.append(Object.assign(document.createElement("span"), { className: `swatch run${i % 4}` }));
    entry.append(name, pill, about);
    return entry;
  });
  at("runs").replaceChildren(...list);
  document.title = `${runs.map((run) => run.name).join(", ")} – rig view`;
  at("message").hidden = true;
  banners();
  control();
  const struts = [...new Set(runs.flatMap((run) => run.struts))];
  const ready = runs.some((run) => run.steps > 0) && struts.length > 0;
  at("charts").hidden = !ready;
  const now = JSON.stringify([runs.map((run) => [run.name, run.columns]), struts]);
  if (ready && now !== shape) {
    const select = at("strut");
    select.replaceChildren(...struts.map((name) => new Option(name, name)));
    strut = struts.includes(strut) ? strut : struts.at(-1);
    select.value = strut;
    at("strut-label").hidden = struts.length < 2;
    const asked = shape === "" ? takeLink() : null;
    build();
    if (shape === "" && !runs.some((run) => run.state === "live")) at("span").value = "whole";
    shape = now;
    newest();
    if (asked) look(...asked);
  }
}

async function frame() {
  if (shape === "") return;
  const moves = runs.some((run) => ["live", "reading"].includes(run.state)) && view.follow;
  if (!changed && !moves) return;
  changed = false;
  if (view.follow && (runs.length > 1 || view.span === null)) {
    view.end = last();
    view.begin = view.span === null ? 0 : view.end - view.span;
  }
  if (view.end <= view.begin) view.end = view.begin + 1e-3;
  // Two points a bucket: one for each pixel.
  const points = Math.min(2000, Math.max(150, Math.round(at("height").clientWidth / 2)));
  draw(await Promise.all(runs.map((_run, index) => stretch(index, points))));
}

// One request after the other; a request that fails is repeated.
function every(period, action) {
  const once = async () => {
    const begin = performance.now();
    try {
      await action();
    } catch (error) {
      changed = true;
      if (error instanceof TypeError && /fetch/i.test(error.message)) lost();
      else console.error(error);
    }
    const pause = document.hidden ? HIDDEN_MS : Math.max(4, period - (performance.now() - begin));
    setTimeout(once, pause);
  };
  once();
}

function lost() {
  at("message").hidden = false;
  at("message").textContent = "No answer from rig view: it has ended, or is busy. The page continues when it answers.";
}

function keyboard(event) {
  if (event.ctrlKey || event.metaKey || event.altKey || ["SELECT", "INPUT"].includes(event.target.tagName) || event.target.role === "tab") return;
  const actions = {
    " ": pause, ArrowLeft: () => move(-0.25), ArrowRight: () => move(0.25), "+": () => zoom(0.5),
    "-": () => zoom(2), Home: () => follow(null), End: newest, m: setReference,
  };
  const action = actions[event.key];
  if (action === undefined || (event.key === " " && event.target.tagName === "BUTTON")) return;
  event.preventDefault();
  action();
}

function theme(name) {
  document.documentElement.dataset.theme = name;
  for (const chart of Object.values(charts)) chart.redraw();
  Glance.redraw();
}

at("span").addEventListener("change", newest);
at("strut").addEventListener("change", () => {
  strut = at("strut").value;
  evaluatedKey = "";
  update();
});
for (const [id, action] of Object.entries({
  pause, back: () => move(-0.5), forth: () => move(0.5), closer: () => zoom(0.5), wider: () => zoom(2),
  whole: () => follow(null), newest,
})) {
  at(id).addEventListener("click", action);
}
at("theme").addEventListener("click", () => {
  const name = document.documentElement.dataset.theme === "dark" ? "light" : "dark";
  localStorage.setItem("theme", name);
  theme(name);
});
document.addEventListener("keydown", keyboard);
Arrange.open(Arrange.kept("tab") ?? "tab-virtual");
theme(localStorage.getItem("theme") ?? (matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light"));
every(RUNS_MS, readRuns);
every(FRAME_MS, frame);
every(CLOSELY_MS, evaluateStretch);
every(RUNS_MS, readDiagnosis);
