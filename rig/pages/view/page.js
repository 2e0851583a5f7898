"use strict";
// The page requests the visible stretch, draws it, and requests again: a slow page only draws less
// often. All data come from the server; the page keeps only the data on the screen.

const FRAME_MS = 48;
const CLOSELY_MS = 1000;
const RUNS_MS = 1000;
const HIDDEN_MS = 1000;
const COLOURS = ["--model", "--second", "--third", "--fourth"];
const TONES = { live: "good", done: "good", safe: "bad", failed: "bad", killed: "warn", reading: "quiet", absent: "quiet", empty: "warn", unreadable: "bad" };

const at = (id) => document.getElementById(id);
// The server's table of plots: columns, labels and units.
const TABLE = JSON.parse(at("table").textContent);
const charts = {};
let runs = [];
let shape = ""; // what the charts were made for
let strut = "";
// `follow`: the end is the newest step. `span` is a length in s, or null for the whole run.
const view = { begin: 0, end: 10, span: 10, follow: true };
let changed = true;
let drawnAt = 0;
let evaluatedKey = "";

async function ask(path, given = {}) {
  const answer = await fetch(`${path}?${new URLSearchParams(given)}`);
  if (!answer.ok) throw new Error(await answer.text());
  return answer;
}

const columnsOf = (name) => [
  ...TABLE.curves.map((curve) => (curve.is_of_strut ? `${name}.${curve.column}` : curve.column)),
  ...TABLE.state.columns,
];

// Whether the newest steps are requested, at any time.
const isFollowing = () => view.follow && runs.length === 1 && view.span !== null;

// A stretch as plain lists: uPlot takes null for nothing.
async function stretch(index, points) {
  const columns = columnsOf(strut);
  const [begin_s, end_s] = isFollowing() ? [0, view.span] : [view.begin, view.end];
  const given = { run: index, begin: begin_s, end: end_s, points, columns: columns.join(",") };
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

// Series of each chart over time.
function seriesOf(several) {
  const measured = (index) => (several ? COLOURS[index % 4] : "--measured");
  const thin = several ? { dash: [4, 4], width: 1 } : { width: 2 };
  const series = { state: [] };
  for (const key of Object.keys(TABLE.labels)) series[key] = [];
  const [first, ...faults] = TABLE.state.columns.map((_name, i) => TABLE.curves.length + i);
  runs.forEach((run, index) => {
    const own = { run: index, colour: COLOURS[index % 4], spanGaps: several };
    TABLE.curves.forEach((curve, column) => {
      // A column that the bench has once is that of a strut only if the model has one strut.
      if (!curve.is_of_strut && !(run.struts.length === 1 && run.columns.includes(curve.column))) return;
      const style = curve.origin === "measured" ? { ...thin, colour: measured(index), spanGaps: true } : {};
      series[curve.plot].push({ column, label: named(index, curve.label), unit: curve.unit, ...own, ...style });
    });
    series.state.push({ column: first, label: named(index, "state"), width: 3, paths: Charts.steps, ...own, level: (v) => v + TABLE.state.first_mode_level });
    faults.forEach((column, level) => series.state.push({
      run: index, column, label: "", width: 0, points: true, colour: several ? own.colour : "--bad", level: (v) => (v > 0 ? level : null),
    }));
  });
  return series;
}

let shown = {};

function build() {
  evaluatedKey = "";
  for (const chart of Object.values(charts)) chart.destroy();
  const several = runs.length > 1;
  shown = seriesOf(several);
  const common = { sync: "t", xLabel: TABLE.time, xUnit: TABLE.time_unit, onSelect: look, onReset: newest };
  const over = (id, yLabel, more = {}) => {
    charts[id] = Charts.lines(at(id), { ...common, yLabel, series: shown[id], ...more });
  };
  for (const [id, label] of Object.entries(TABLE.labels)) over(id, label);
  const { levels } = TABLE.state;
  over("state", "", {
    rangeY: [-0.5, levels.length - 0.5],
    yValues: (_u, ticks) => ticks.map((v) => levels[v] ?? ""),
    yAxis: { splits: () => levels.map((_name, i) => i), size: 90, labelSize: 0 },
    named: shown.state.map((item) => item.label !== ""),
  });
  const laws = several ? runs.map((run, i) => ({ label: `${run.name}: law`, colour: COLOURS[i % 4], dash: [8, 4] })) : [{ label: "model’s law", colour: "--model" }];
  const { planes, spectrum, ticks } = TABLE;
  const points = runs.flatMap((run, i) => [
    { label: several ? run.name : planes.estimated, colour: several ? COLOURS[i % 4] : "--second", dots: true },
    { label: named(i, planes.measured), colour: "--measured", dots: true },
  ]);
  for (const { name, label } of Object.values(planes.motions)) {
    charts[`plane-${name}`] = Charts.plane(at(`plane-${name}`), {
      xLabel: label, yLabel: planes.force, series: [...points, ...laws, { label: "other models", colour: "--third", dash: [3, 3] }],
    });
  }
  const { frequency } = spectrum;
  charts.spectrum = Charts.lines(at("spectrum"), {
    xLabel: frequency.label, xName: frequency.name, xUnit: frequency.unit, yLabel: "N / √Hz", logX: true, logY: true,
    series: runs.map((run, i) => ({ label: several ? run.name : spectrum.label, unit: "N/√Hz", colour: COLOURS[i % 4], spanGaps: true })),
  });
  charts.timing = Charts.lines(at("timing"), {
    xLabel: ticks.time, xName: "from", xUnit: ticks.time_unit, yLabel: "ticks", logX: true, logY: true,
    series: ticks.curves.map((label, i) => ({ label, colour: ["--second", "--model"][i], paths: Charts.steps })),
  });
}

function draw(found) {
  const [first] = found;
  if (isFollowing()) {
    view.end = first.head.end_s;
    view.begin = view.end - view.span;
  }
  found.forEach((item, i) => {
    runs[i].span_s = item.head.span_s;
    runs[i].state = item.head.state;
  });
  // A long run is read piece by piece: the whole of it is longer the next time.
  if (view.follow && last() > view.end + 1e-6) changed = true;
  const width = columnsOf(strut).length;
  const t = found.length === 1 ? [first.t, ...first.lists] : uPlot.join(found.map((item) => [item.t, ...item.lists]));
  for (const id of Object.keys(shown)) {
    const lists = shown[id].map((item) => {
      const list = t[1 + item.run * width + item.column];
      return item.level ? list.map((v) => (v === null || v === undefined ? null : item.level(v))) : list;
    });
    charts[id].set([t[0], ...lists], view.begin, view.end);
  }
  const steps = found.reduce((sum, item) => sum + item.head.steps, 0);
  at("shown").textContent = `${view.begin.toFixed(2)} to ${view.end.toFixed(2)} s, ${steps.toLocaleString("en")} ticks`;
  document.body.dataset.end = first.head.span_s[1];
  document.body.dataset.frames = Number(document.body.dataset.frames ?? 0) + 1;
}

async function evaluateStretch() {
  const key = [view.begin, view.end, strut].join();
  if (document.hidden || shape === "" || key === evaluatedKey) return;
  const given = { begin: view.begin, end: view.end, strut };
  const found = await Promise.all(runs.map(async (_run, run) => (await ask("closely", { run, ...given })).json()));
  for (const [id, { name }] of Object.entries(TABLE.planes.motions)) {
    const points = found.flatMap((item) => [item.planes[`${id}:estimated`], item.planes[`${id}:measured`]]);
    const own = found.map((item) => item.laws.model?.[id] ?? [[], []]);
    const others = Object.entries(found[0].laws).filter(([other]) => other !== "model").map(([, law]) => law[id]);
    // One line for all others, with a gap between two.
    const joined = others.reduce(([xs, ys], [x, y]) => [[...xs, NaN, ...x], [...ys, NaN, ...y]], [[], []]);
    charts[`plane-${name}`].set([...points, ...own, joined]);
  }
  const spectra = found.map((item) => [item.spectrum.frequency_hz, item.spectrum.density]);
  charts.spectrum.set(spectra.length === 1 ? spectra[0] : uPlot.join(spectra));
  const timing = found[0].timing;
  at("timing").closest("section").hidden = !timing;
  if (timing) {
    const some = (list) => list.map((v) => (v > 0 ? v : null));
    charts.timing.set([timing.edges_us.map((v) => Math.max(v, 0.5)), ...TABLE.ticks.curves.map((name) => some(timing[name]))]);
  }
  at("longest").textContent = found[0].longest_s;
  figures(found);
  evaluatedKey = key;
}

function figures(found) {
  const rows = [];
  found.forEach((item, i) => {
    const name = runs.length > 1 ? `${runs[i].name}: ` : "";
    if (item.bus.load !== undefined) {
      rows.push([`${name}bus load`, `${(100 * item.bus.load).toFixed(1)} %`]);
      rows.push([`${name}frames`, `${item.bus.frames_per_s.toFixed(0)} /s`]);
    }
    if (item.timing) rows.push([`${name}longest gap`, `${(item.timing.longest_gap_us / 1000).toFixed(2)} ms`]);
    const counts = Object.entries(runs[i].counts ?? {}).filter(([key, value]) => value > 0 && key !== "started");
    for (const [key, value] of counts) rows.push([`${name}${key.replaceAll("_", " ")}`, value.toLocaleString("en")]);
    if (runs[i].counts && counts.length === 0) rows.push([`${name}faults counted`, "none"]);
    if (runs[i].diverged) rows.push([`${name}diverged`, `${runs[i].diverged.strut}, ${runs[i].diverged.t_s.toFixed(3)} s`]);
  });
  const list = at("figures");
  list.replaceChildren(
    ...rows.map(([name, value]) => {
      const pair = document.createElement("div");
      pair.append(Object.assign(document.createElement("dt"), { textContent: name }), Object.assign(document.createElement("dd"), { textContent: value }));
      return pair;
    }),
  );
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
  const named = runs.length > 1 && live >= 0 ? `Control of ${runs[live].name}` : "Control";
  at("control").querySelector("h2").textContent = named;
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
  at("answer").textContent = found.error ?? (found.requested ? `Requested: ${found.requested}.` : `Changed from ${(found.t_ns * 1e-9).toFixed(3)} s on.`);
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
    const pill = Object.assign(document.createElement("span"), { textContent: run.state, title: run.words, className: `pill ${TONES[run.state] ?? "quiet"}` });
    const about = Object.assign(document.createElement("span"), { className: "quiet", textContent: [run.model, run.rate_hz ? `${run.rate_hz} Hz` : ""].filter(Boolean).join(", ") });
    if (runs.length > 1) entry.append(Object.assign(document.createElement("span"), { className: `swatch run${i % 4}` }));
    entry.append(name, pill, about);
    return entry;
  });
  at("runs").replaceChildren(...list);
  document.title = `${runs.map((run) => run.name).join(", ")} – rig view`;
  const said = runs.filter((run) => !["live", "done"].includes(run.state)).map((run) => run.words);
  at("message").hidden = said.length === 0;
  at("message").textContent = said.join(" ");
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
    build();
    if (shape === "" && !runs.some((run) => run.state === "live")) {
      at("span").value = "whole";
    }
    shape = now;
    newest();
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
  if (event.ctrlKey || event.metaKey || event.altKey || ["SELECT", "INPUT"].includes(event.target.tagName)) return;
  const actions = {
    " ": pause, ArrowLeft: () => move(-0.25), ArrowRight: () => move(0.25), "+": () => zoom(0.5),
    "-": () => zoom(2), Home: () => follow(null), End: newest,
  };
  const action = actions[event.key];
  if (action === undefined || (event.key === " " && event.target.tagName === "BUTTON")) return;
  event.preventDefault();
  action();
}

function theme(name) {
  document.documentElement.dataset.theme = name;
  for (const chart of Object.values(charts)) chart.redraw();
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
theme(localStorage.getItem("theme") ?? (matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light"));
every(RUNS_MS, readRuns);
every(FRAME_MS, frame);
every(CLOSELY_MS, evaluateStretch);
every(RUNS_MS, readDiagnosis);
