"use strict";
// Charts on uPlot that the pages share: lines over time, points in a plane, steps of a histogram.
// Colours are names of CSS properties, so that a change of theme only asks for another drawing.

const Charts = (() => {
  const colour = (name) =>
    name.startsWith("--")
      ? getComputedStyle(document.documentElement).getPropertyValue(name).trim()
      : name;

  // Numbers as in the reports: a true minus, narrow spaces between thousands, as many decimals as
  // asked for.
  const fixed = (value, decimals) => {
    const [whole, part] = Math.abs(value).toFixed(Math.max(0, decimals)).split(".");
    const grouped = whole.replace(/\B(?=(\d{3})+$)/g, "\u202f") + (part ? `.${part}` : "");
    return value < 0 && /[1-9]/.test(grouped) ? `\u2212${grouped}` : grouped;
  };

  // Five digits; powers of ten far from one. NaN and null are nothing.
  const number = (value) => {
    if (value === null || value === undefined || Number.isNaN(value)) return "–";
    const size = Math.abs(value);
    if (size !== 0 && (size < 1e-4 || size >= 1e6)) return value.toExponential(3).replaceAll("-", "\u2212");
    return fixed(value, size === 0 ? 0 : 4 - Math.floor(Math.log10(size)));
  };

  const axis = (label, size, more) => ({
    label,
    size,
    labelSize: 18,
    labelGap: 0,
    gap: 3,
    font: "12px system-ui, sans-serif",
    labelFont: "12px system-ui, sans-serif",
    stroke: () => colour("--axis"),
    grid: { stroke: () => colour("--grid"), width: 1 },
    ticks: { stroke: () => colour("--grid"), width: 1, size: 4 },
    ...more,
  });

  const short = (u, values) =>
    values.map((v) => {
      if (v === null || v === undefined) return "";
      const size = Math.abs(v);
      const text = size !== 0 && (size < 1e-3 || size >= 1e5) ? v.toExponential(0) : String(+v.toPrecision(6));
      return text.replaceAll("-", "\u2212");
    });

  // An axis about the values, never shorter than a span: noise at rest fills no chart.
  const spanning = (least) => (_u, low, high) => {
    if (low === null || high === null) return [-0.5 * least, 0.5 * least];
    const half = Math.max(0.54 * (high - low), 0.5 * least);
    return [0.5 * (low + high) - half, 0.5 * (low + high) + half];
  };

  // Five decades below the largest value, and some where all are zero.
  const decades = (_u, low, high) => (high > 1e-9 ? [Math.max(low, high * 1e-5), 2 * high] : [1e-3, 1]);

  // A channel that is sampled less often than the ticks has no value at most of them: its line goes
  // on. Where several samples are missing there was none, and the line has a gap.
  const MISSING = 5;

  function longGaps(u, index, first, last, gaps) {
    const [x, y] = [u.data[0], u.data[index]];
    const places = [];
    for (let i = first; i <= last; i++) {
      if (y[i] !== null && y[i] !== undefined) places.push(u.valToPos(x[i], "x", true));
    }
    const steps = places.slice(1).map((place, i) => place - places[i]).sort((a, b) => a - b);
    // Thinned curves have pairs of values: the longer step is the one between two samples.
    const usual = steps[Math.floor(0.75 * steps.length)] ?? 0;
    return gaps.filter(([from, to]) => to - from > MISSING * usual);
  }

  const line = (item) => ({
    label: item.label,
    stroke: () => colour(item.colour),
    width: item.width ?? 1,
    dash: item.dash,
    spanGaps: false,
    ...(item.spanGaps ? { gaps: longGaps } : {}),
    points: { show: item.points ?? false, size: 4 },
    paths: item.paths,
    value(u, given, index, at) {
      // Without a cursor the legend holds the last values: those of one time, if they are given.
      const last = () => (u.latest ? u.latest[index] : u.data[index][lastOf(u.data[index])]) ?? null;
      const v = given === null && !(u.cursor.left >= 0) ? last() : given;
      return `${number(v)}${item.unit ? ` ${item.unit}` : ""}${difference(u, v, index, at)}`;
    },
  });

  // The second cursor: a time in s, or null. Values at the first one are given with their differences
  // from those at the second one.
  const reference = { x: null };

  function difference(u, v, index, at) {
    if (reference.x === null || u.spec?.sync === undefined || typeof v !== "number" || at === null) return "";
    const from = u.valToIdx(reference.x);
    const base = nearest(u.data[index], from);
    return base === null ? "" : ` (Δ ${number(v - u.data[index][base])})`;
  }

  // Index of the value next to an index that there is; null without any within a hundred.
  function nearest(list, from) {
    for (let by = 0; by < 100; by++) {
      for (const i of [from - by, from + by]) {
        if (list[i] !== null && list[i] !== undefined) return i;
      }
    }
    return null;
  }

  const lastOf = (list) => {
    for (let i = list.length - 1; i >= 0; i--) if (list[i] !== null && list[i] !== undefined) return i;
    return null;
  };

  const width = (element) => Math.max(60, Math.floor(element.clientWidth));
  const height = (element) => parseInt(getComputedStyle(element).getPropertyValue("--height"), 10);

  const sizeOf = (element) => ({ width: width(element), height: height(element) });

  // A chart follows the width of its element, at the height in the element’s style; its legend
  // stands below.
  const followWidth = (element, chart) => {
    const observer = new ResizeObserver(() => {
      if (chart.width !== width(element) && !matchMedia("print").matches) chart.setSize(sizeOf(element));
    });
    observer.observe(element);
    return () => {
      observer.disconnect();
      chart.destroy();
    };
  };

  // A grey band about zero, and marks where recordings begin, behind the curves.
  const behind = (spec) => (u) => {
    const { left, top, width: wide, height: high } = u.bbox;
    const ctx = u.ctx;
    ctx.save();
    if (spec.reach > 0) {
      const inside = (v) => Math.min(Math.max(u.valToPos(v, "y", true), top), top + high);
      const [upper, lower] = [inside(spec.reach), inside(-spec.reach)];
      ctx.fillStyle = colour("--band");
      ctx.fillRect(left, upper, wide, lower - upper);
    }
    // Where an effect acts, as a bar along the abscissa.
    for (const [first, last] of spec.acting ?? []) {
      const [x, end] = [first, last].map((v) => Math.min(Math.max(u.valToPos(v, "x", true), left), left + wide));
      const thick = 6 * devicePixelRatio;
      ctx.fillStyle = colour("--law");
      ctx.fillRect(x, top + high - thick, end - x, thick);
    }
    ctx.fillStyle = ctx.strokeStyle = colour("--axis");
    ctx.font = `${11 * devicePixelRatio}px system-ui, sans-serif`;
    for (const mark of spec.marks ?? []) {
      const [x, end] = [mark.begin, mark.end].map((v) => u.valToPos(v, "x", true));
      if (x < left || x > left + wide) continue;
      ctx.globalAlpha = 0.5;
      ctx.fillRect(x, top, devicePixelRatio, high);
      ctx.globalAlpha = 1;
      // A name that would run into the next one says nothing.
      if (ctx.measureText(mark.name).width < end - x - 8) ctx.fillText(mark.name, x + 4, top + 12 * devicePixelRatio);
    }
    ctx.strokeStyle = colour("--bad");
    ctx.lineWidth = devicePixelRatio;
    ctx.setLineDash([6 * devicePixelRatio, 4 * devicePixelRatio]);
    for (const limit of spec.limits ?? []) {
      const y = u.valToPos(limit, "y", true);
      if (y >= top && y <= top + high) across(ctx, [left, y], [left + wide, y]);
    }
    if (spec.sync !== undefined && reference.x !== null) {
      const x = u.valToPos(reference.x, "x", true);
      ctx.strokeStyle = colour("--accent");
      if (x >= left && x <= left + wide) across(ctx, [x, top], [x, top + high]);
    }
    ctx.restore();
  };

  const across = (ctx, from, to) => {
    ctx.beginPath();
    ctx.moveTo(...from);
    ctx.lineTo(...to);
    ctx.stroke();
  };

  // Samples of lines are dashed as they are; those of points are filled.
  const markers = { fill: (u, i) => u.series[i].stroke(u, i), dash: (u, i) => (u.series[i].dash ? "dashed" : "solid"), width: 2 };

  // A figure of one chart, whose head has a place for the legend.
  const figureOf = (element) => element.closest(".figure[data-chart]");

  const placeLegend = (element, chart) => {
    const legend = chart.root.querySelector(".u-legend");
    figureOf(element)?.querySelector(".legend")?.replaceChildren(legend);
    return legend;
  };

  // Lines over a common axis. `onSelect` is given the ends of a stretch that was drawn.
  function lines(element, spec) {
    const chart = new uPlot(
      {
        width: width(element),
        height: height(element),
        padding: [8, 12, 0, 0],
        cursor: {
          sync: spec.sync ? { key: spec.sync } : undefined,
          drag: { x: true, y: false, setScale: spec.onSelect === undefined },
          focus: { prox: 16 },
        },
        focus: { alpha: 0.5 },
        legend: { live: true, markers },
        scales: {
          x: { time: false, distr: spec.logX ? 3 : 1, range: spec.rangeX },
          y: { distr: spec.logY ? 3 : 1, range: spec.rangeY ?? (spec.leastSpan ? spanning(spec.leastSpan) : undefined) },
        },
        axes: [
          axis(spec.xLabel, 24, { values: short, ...spec.xAxis }),
          axis(spec.yLabel, 62, { values: spec.yValues ?? short, ...spec.yAxis }),
        ],
        series: [
          { label: spec.xName ?? "t", value: (_u, v) => (v === null ? "–" : `${number(v)} ${spec.xUnit ?? ""}`) },
          ...spec.series.map(line),
        ],
        bands: spec.bands?.map((band) => ({ series: band.series, fill: () => colour(band.colour) })),
        hooks: {
          drawAxes: [behind(spec)],
          setSelect: [
            (u) => {
              if (spec.onSelect === undefined || u.select.width < 4) return;
              const begin = u.posToVal(u.select.left, "x");
              const end = u.posToVal(u.select.left + u.select.width, "x");
              u.setSelect({ left: 0, width: 0, top: 0, height: 0 }, false);
              spec.onSelect(begin, end);
            },
          ],
        },
      },
      [[], ...spec.series.map(() => [])],
      element,
    );
    chart.spec = spec;
    element.querySelector(".u-series").classList.add("abscissa");
    placeLegend(element, chart);
    if (spec.onReset) chart.over.addEventListener("dblclick", spec.onReset);
    return {
      chart,
      destroy: followWidth(element, chart),
      set(data, begin, end) {
        // An axis without a curve shows nothing.
        figureOf(element)?.classList.toggle("empty", data.slice(1).every((list) => lastOf(list) === null));
        chart.batch(() => {
          chart.setData(data, begin === undefined);
          if (begin !== undefined) chart.setScale("x", { min: begin, max: end });
        });
        if (!(chart.cursor.left >= 0) && data[0].length) chart.setLegend({ idx: data[0].length - 1 }, false);
      },
      redraw: () => chart.redraw(false, true),
    };
  }

  // What uPlot asks of a series that is no line over a common axis: it draws itself.
  const drawn = (draw) => (u, index) => {
    uPlot.orient(u, index, (series, _x, _y, scaleX, scaleY, posX, posY, left, top, wide, high) => {
      const [xs, ys] = u.data[index];
      // Null would be the place of zero.
      const known = (v) => v ?? NaN;
      const at = (i) => {
        const x = posX(known(xs[i]) + 0 * known(ys[i]), scaleX, wide, left);
        return [x, posY(known(ys[i]), scaleY, high, top)];
      };
      const ctx = u.ctx;
      ctx.save();
      ctx.beginPath();
      ctx.rect(left, top, wide, high);
      ctx.clip();
      draw(ctx, series, xs.length, at);
      ctx.restore();
    });
    return null;
  };

  const dots = drawn((ctx, series, count, at) => {
    const size = 2.2 * devicePixelRatio;
    ctx.fillStyle = series.stroke();
    ctx.globalAlpha = series.alpha_ ?? 0.45; // so that a curve shows over them
    for (let i = 0; i < count; i++) {
      const [x, y] = at(i);
      ctx.fillRect(x - size / 2, y - size / 2, size, size);
    }
  });

  const curve = drawn((ctx, series, count, at) => {
    ctx.strokeStyle = series.stroke();
    ctx.lineWidth = series.width * devicePixelRatio;
    ctx.setLineDash((series.dash ?? []).map((d) => d * devicePixelRatio));
    ctx.beginPath();
    let down = false;
    for (let i = 0; i < count; i++) {
      const [x, y] = at(i);
      // Where there is no number the pen is lifted.
      if (Number.isNaN(x)) down = false;
      else if (down) ctx.lineTo(x, y);
      else ctx.moveTo(x, y);
      down = down || !Number.isNaN(x);
    }
    ctx.stroke();
  });

  const padded = (values, least = 0) => {
    let low = Infinity;
    let high = -Infinity;
    for (const list of values) {
      for (const v of list) {
        if (v === null) continue;
        if (v < low) low = v;
        if (v > high) high = v;
      }
    }
    if (!(low <= high)) return [0, least || 1];
    const margin = Math.max(0.05 * (high - low || Math.abs(high) || 1), 0.5 * (least - high + low));
    return [low - margin, high + margin];
  };

  // Points and curves in a plane; every series has its own abscissae.
  function plane(element, spec) {
    let data = spec.series.map(() => [[], []]);
    const chart = new uPlot(
      {
        mode: 2,
        width: width(element),
        height: height(element),
        padding: [8, 12, 0, 0],
        cursor: { drag: { x: false, y: false }, points: { show: false } },
        legend: { live: false, markers },
        hooks: { drawAxes: [behind(spec)] },
        scales: {
          x: { time: false, range: () => padded(data.map((pair) => pair[0]), spec.leastX) },
          y: { range: () => padded(data.map((pair) => pair[1]), spec.leastY) },
        },
        axes: [axis(spec.xLabel, 24, { values: short }), axis(spec.yLabel, 62, { values: short })],
        series: [
          {},
          ...spec.series.map((item) => ({
            label: item.label,
            stroke: () => colour(item.colour),
            width: item.width ?? 2,
            dash: item.dash,
            paths: item.dots ? dots : curve,
            alpha_: item.faint ? 0.22 : undefined,
            points: { show: false },
          })),
        ],
      },
      [null, ...data],
      element,
    );
    const legend = placeLegend(element, chart);
    return {
      chart,
      destroy: followWidth(element, chart),
      set(pairs) {
        data = pairs;
        figureOf(element)?.classList.toggle("empty", pairs.every((pair) => pair[0].length === 0));
        // In this mode uPlot counts the points of the data before: without any it draws nothing.
        chart.setData([null, ...pairs], false);
        chart.setData([null, ...pairs]);
        // An empty series has no entry in the legend.
        legend.querySelectorAll(".u-series").forEach((entry, i) => {
          entry.hidden = pairs[i][0].length === 0;
          entry.classList.toggle("dots", Boolean(spec.series[i].dots));
        });
      },
      redraw: () => chart.redraw(false, true),
    };
  }

  // Blue above zero, red below: they stay apart for colour-blind readers. Zero is grey, so that it
  // is not taken for a cell without samples.
  const diverging = (share) => {
    const end = share > 0 ? [5, 90, 160] : [190, 60, 20];
    const part = Math.min(1, Math.abs(share)) ** 0.7;
    return `rgb(${end.map((v) => Math.round(236 + part * (v - 236))).join(",")})`;
  };

  // Cells of a plane by their middles; `z` row by row, null where there is nothing.
  function cells(element, spec, xs, ys, z) {
    const half = (list) => 0.5 * (list[1] - list[0]);
    const [dx, dy] = [half(xs), half(ys)];
    const fill = (u) => {
      const ctx = u.ctx;
      z.forEach((value, i) => {
        if (value === null) return;
        const [x, y] = [xs[i % xs.length], ys[Math.floor(i / xs.length)]];
        const [left, right] = [x - dx, x + dx].map((v) => Math.round(u.valToPos(v, "x", true)));
        const [upper, lower] = [y + dy, y - dy].map((v) => Math.round(u.valToPos(v, "y", true)));
        ctx.fillStyle = diverging(value / spec.largest);
        ctx.fillRect(left, upper, right - left, lower - upper);
      });
    };
    const chart = new uPlot(
      {
        width: width(element),
        height: height(element),
        title: spec.title,
        padding: [8, 12, 0, 0],
        cursor: { drag: { x: false, y: false }, points: { show: false } },
        legend: { show: false },
        hooks: { draw: [fill] },
        scales: {
          x: { time: false, range: [xs[0] - dx, xs.at(-1) + dx] },
          y: { range: [ys[0] - dy, ys.at(-1) + dy] },
        },
        axes: [axis(spec.xLabel, 24, { values: short }), axis(spec.yLabel, 62, { values: short })],
        series: [{}, { show: false }],
      },
      [xs, xs.map(() => null)],
      element,
    );
    return { chart, destroy: followWidth(element, chart), redraw: () => chart.redraw(false, true) };
  }

  // A line without axes, with the limits of its quantity.
  function spark(element, spec) {
    const chart = new uPlot(
      {
        ...sizeOf(element),
        padding: [3, 0, 3, 0],
        cursor: { show: false },
        legend: { show: false },
        hooks: { drawAxes: [behind(spec)] },
        scales: { x: { time: false }, y: { range: spanning(spec.leastSpan) } },
        axes: [{ show: false }, { show: false }],
        series: [{}, { stroke: () => colour(spec.colour), width: 1.5, points: { show: false }, spanGaps: true }],
      },
      [[], []],
      element,
    );
    return {
      chart,
      destroy: followWidth(element, chart),
      set: (data, begin, end) => chart.batch(() => {
        chart.setData(data, false);
        chart.setScale("x", { min: begin, max: end });
        chart.setScale("y", { min: null, max: null });
      }),
      redraw: () => chart.redraw(false, true),
    };
  }

  // Modes of one or several runs as bands over time, faults as marks above them, events as flags.
  function band(element, spec) {
    const lanes = spec.lanes.length;
    const draw = (u) => {
      const { left, top, width: wide, height: high } = u.bbox;
      const ctx = u.ctx;
      const ratio = devicePixelRatio;
      const [marks, each] = [10 * ratio, (high - 10 * ratio) / lanes];
      ctx.save();
      ctx.beginPath();
      ctx.rect(left, top, wide, high);
      ctx.clip();
      ctx.font = `600 ${11 * ratio}px system-ui, sans-serif`;
      ctx.textBaseline = "middle";
      ctx.textAlign = "left";
      const x = (t) => u.valToPos(t, "x", true);
      spec.lanes.forEach((lane, number) => {
        const upper = top + marks + number * each;
        for (const [from, to, mode] of stretches(u.data[0], u.data[lane.mode])) {
          const [name, tone] = spec.modes[mode] ?? ["", "idle"];
          const [begin, end] = [x(from), x(to)];
          ctx.fillStyle = colour(`--band-${tone}`);
          ctx.fillRect(begin, upper + ratio, Math.max(end - begin, ratio), each - 2 * ratio);
          ctx.fillStyle = "#fff";
          const shown = Math.max(begin, left);
          if (ctx.measureText(name).width < Math.min(end, left + wide) - shown - 8 * ratio) ctx.fillText(name, shown + 5 * ratio, upper + 0.5 * each);
        }
        ctx.fillStyle = colour("--bad");
        for (const fault of lane.faults) {
          u.data[fault].forEach((value, i) => {
            if (value > 0) ctx.fillRect(x(u.data[0][i]) - ratio, top, 2 * ratio, marks - 2 * ratio);
          });
        }
      });
      ctx.restore();
    };
    const made = lines(element, { ...spec, series: spec.series.map((item) => ({ ...item, paths: () => null })), yAxis: { show: true, values: () => [], grid: { show: false }, ticks: { show: false } }, rangeY: [0, 1] });
    made.chart.hooks.draw = [draw];
    return made;
  }

  // Stretches of a list of modes: begin, end, mode. A value lasts until the next one.
  function stretches(t, modes) {
    const found = [];
    let open = null;
    t.forEach((time, i) => {
      const mode = modes[i];
      if (mode === null || mode === undefined) return;
      if (open && open[2] === mode) open[1] = time;
      else {
        if (open) open[1] = time;
        open = [time, time, mode];
        found.push(open);
      }
    });
    return found;
  }

  const steps = uPlot.paths.stepped({ align: 1 });
  return { lines, plane, cells, spark, band, steps, sizeOf, fixed, number, reference, decades, lastOf };
})();
