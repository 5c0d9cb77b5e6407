// Error against cost: a plot with logarithmic axes. Down is better.

// Powers of ten, with 2 and 5 between them where they are few.
function logTicks(low, high) {
  const first = Math.floor(Math.log10(low)), last = Math.ceil(Math.log10(high));
  const factors = last - first <= 2 ? [1, 2, 5] : [1], every = Math.ceil((last - first) / 8);
  const values = [];
  for (let power = first; power <= last; power += every) values.push(...factors.map((factor) => factor * 10 ** power));
  const shown = values.filter((value) => value >= low * (1 - 1e-9) && value <= high * (1 + 1e-9));
  return shown.length >= 2 ? shown : ticks(low, high, 4);
}

const superscript = (power) => String(power).replace(/[-0-9]/g, (c) => (c === "-" ? "⁻" : "⁰¹²³⁴⁵⁶⁷⁸⁹"[Number(c)]));
// 0.012, 10⁻⁴, 3.5·10⁻⁵
function shortNumber(value) {
  if (value === 0 || (value >= 0.01 && value < 1e4)) return String(Number(value.toPrecision(2)));
  const [digits, power] = value.toExponential(1).split("e");
  return `${Number(digits) === 1 ? "" : `${Number(digits)}·`}10${superscript(Number(power))}`;
}

// series: [{name, points: [{x, y, low?, high?, label, chosen?}]}], x and y > 0 unless `linear` is given for y; bands go
// from low to high. options: {title, x, y: axis texts, linear: whether y is linear, scatter: points without a line}.
function makeLogPlot(series, options) {
  const points = series.flatMap((one) => one.points);
  const plot = svg("svg", {role: "img", "aria-label": options.title});
  const tip = el("div", {className: "tip", hidden: true});
  const legend = el("div", {className: "legend"}, ...(series.length > 1
    ? series.map((one, i) => el("span", {}, el("i", {className: `series-${i}`}), one.name)) : []));
  const chart = el("div", {className: "chart"}, el("h3", {}, options.title), legend, plot, tip);
  const xs = points.map((point) => point.x), ys = points.flatMap((point) => [point.y, point.low ?? point.y, point.high ?? point.y]);
  const range = (values, linear) => {
    const least = Math.min(...values), most = Math.max(...values);
    if (linear) { const spread = Math.max(most - least, 0.5); return [least - 0.12 * spread, most + 0.12 * spread]; }
    const room = Math.max((most / least) ** 0.08, 1.15);
    return [least / room, most * room];
  };
  const [xLow, xHigh] = range(xs, false), [yLow, yHigh] = range(ys, options.linear);
  onWidth(plot, (width) => {
    const height = Math.max(220, Math.min(320, 0.62 * width)), margin = {left: 58, right: 14, top: 24, bottom: 44};
    const along = (value, low, high) => Math.log(value / low) / Math.log(high / low);
    const x = (value) => margin.left + along(value, xLow, xHigh) * (width - margin.left - margin.right);
    const yShare = (value) => (options.linear ? (value - yLow) / (yHigh - yLow) : along(value, yLow, yHigh));
    const y = (value) => height - margin.bottom - yShare(value) * (height - margin.top - margin.bottom);
    plot.replaceChildren();
    plot.setAttribute("viewBox", `0 0 ${width} ${height}`);
    plot.style.height = `${height}px`;
    for (const value of options.linear ? ticks(yLow, yHigh, 6) : logTicks(yLow, yHigh)) {
      plot.append(svg("line", {class: "grid", x1: margin.left, x2: width - margin.right, y1: y(value), y2: y(value)}),
        svg("text", {x: margin.left - 8, y: y(value) + 4, "text-anchor": "end"}, options.linear ? Number(value.toFixed(2)) : shortNumber(value)));
    }
    for (const value of logTicks(xLow, xHigh)) {
      plot.append(svg("text", {x: x(value), y: height - margin.bottom + 18, "text-anchor": "middle"}, shortNumber(value)));
    }
    plot.append(svg("text", {x: 0, y: 12}, options.y), svg("text", {x: width - margin.right, y: height - 6, "text-anchor": "end"}, options.x));
    series.forEach((one, i) => {
      const at = (point, key) => `${x(point.x).toFixed(1)},${y(point[key]).toFixed(1)}`;
      const banded = one.points.filter((point) => isNumber(point.low) && isNumber(point.high));
      if (banded.length > 1) {
        plot.append(svg("path", {class: `band series-${i}`,
          d: `M${banded.map((point) => at(point, "high")).join("L")}L${[...banded].reverse().map((point) => at(point, "low")).join("L")}Z`}));
      }
      if (!options.scatter) plot.append(svg("path", {class: `line series-${i}`, d: `M${one.points.map((point) => at(point, "y")).join("L")}`}));
      for (const point of one.points) {
        plot.append(svg("circle", {class: `point series-${i}${point.chosen ? " chosen" : ""}`, cx: x(point.x), cy: y(point.y), r: point.chosen ? 7 : 3.5}));
      }
    });
    const cursor = svg("g");
    plot.append(cursor);
    plot.onpointermove = plot.onpointerdown = (event) => {
      const box = plot.getBoundingClientRect(), px = event.clientX - box.left, py = event.clientY - box.top;
      const far = (point) => (x(point.x) - px) ** 2 + (y(point.y) - py) ** 2;
      const point = points.reduce((best, other) => (far(other) < far(best) ? other : best));
      cursor.replaceChildren(svg("circle", {class: "cursor", cx: x(point.x), cy: y(point.y), r: 9}));
      tip.replaceChildren(...point.label.map(([label, value]) => el("div", {}, el("span", {className: "muted"}, label), el("b", {}, value))));
      tip.hidden = false;
      const onLeft = x(point.x) > width / 2;
      tip.style.left = `${plot.offsetLeft + x(point.x) + (onLeft ? -tip.offsetWidth - 14 : 14)}px`;
      tip.style.top = `${plot.offsetTop + 20}px`;
    };
    plot.onpointerleave = () => { cursor.replaceChildren(); tip.hidden = true; };
  });
  return chart;
}
