"use strict";
// Charts on uPlot that the pages share: lines over time, points in a plane, steps of a histogram.
// Colours are names of CSS properties, so that a change of theme only asks for another drawing.

const Charts = (() => {
  const colour = (name) =>
    name.startsWith("--")
      ? getComputedStyle(document.documentElement).getPropertyValue(name).trim()
      : name;

  // Five digits, in the notation that is shorter; NaN and null are nothing.
  const number = (value) => {
    if (value === null || value === undefined || Number.isNaN(value)) return "–";
    const size = Math.abs(value);
    if (size !== 0 && (size < 1e-4 || size >= 1e6)) return value.toExponential(3);
    return value.toPrecision(5);
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
      return size !== 0 && (size < 1e-3 || size >= 1e5) ? v.toExponential(0) : String(+v.toPrecision(6));
    });

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
    const usual = steps[Math.floor(steps.length / 2)] ?? 0;
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
    value: (_u, v) => `${number(v)}${item.unit ? ` ${item.unit}` : ""}`,
  });

  const width = (element) => Math.max(200, Math.floor(element.clientWidth));
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
    ctx.restore();
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
        legend: { live: true },
        scales: {
          x: { time: false, distr: spec.logX ? 3 : 1, range: spec.rangeX },
          y: { distr: spec.logY ? 3 : 1, range: spec.rangeY },
        },
        axes: [
          axis(spec.xLabel, 24, { values: short }),
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
    element.querySelector(".u-series").classList.add("abscissa");
    spec.named?.forEach((isNamed, i) => {
      element.querySelectorAll(".u-series")[i + 1].hidden = !isNamed;
    });
    if (spec.onReset) chart.over.addEventListener("dblclick", spec.onReset);
    return {
      chart,
      destroy: followWidth(element, chart),
      set(data, begin, end) {
        chart.batch(() => {
          chart.setData(data, begin === undefined);
          if (begin !== undefined) chart.setScale("x", { min: begin, max: end });
        });
      },
      redraw: () => chart.redraw(false, true),
    };
  }

  // What uPlot asks of a series that is no line over a common axis: it draws itself.
  const drawn = (draw) => (u, index) => {
    uPlot.orient(u, index, (series, _x, _y, scaleX, scaleY, posX, posY, left, top, wide, high) => {
      const [xs, ys] = u.data[index];
      const at = (i) => [posX(xs[i], scaleX, wide, left), posY(ys[i], scaleY, high, top)];
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
    ctx.globalAlpha = 0.45; // so that a curve shows over them
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

  const padded = (values) => {
    let low = Infinity;
    let high = -Infinity;
    for (const list of values) {
      for (const v of list) {
        if (v < low) low = v;
        if (v > high) high = v;
      }
    }
    if (!(low <= high)) return [0, 1];
    const margin = 0.05 * (high - low || Math.abs(high) || 1);
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
        legend: { live: false },
        hooks: { drawAxes: [behind(spec)] },
        scales: {
          x: { time: false, range: () => padded(data.map((pair) => pair[0])) },
          y: { range: () => padded(data.map((pair) => pair[1])) },
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
            points: { show: false },
          })),
        ],
      },
      [null, ...data],
      element,
    );
    return {
      chart,
      destroy: followWidth(element, chart),
      set(pairs) {
        data = pairs;
        // In this mode uPlot counts the points of the data before: without any it draws nothing.
        chart.setData([null, ...pairs], false);
        chart.setData([null, ...pairs]);
        // An empty series has no entry in the legend.
        element.querySelectorAll(".u-series").forEach((entry, i) => {
          entry.hidden = pairs[i][0].length === 0;
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

  const steps = uPlot.paths.stepped({ align: 1 });
  return { lines, plane, cells, steps, sizeOf };
})();
