// Held-out PSNR over training time.

// About `n` round values that span [low, high].
function ticks(low, high, n) {
  const raw = (high - low) / n, magnitude = 10 ** Math.floor(Math.log10(raw));
  const step = magnitude * [1, 2, 5, 10].find((factor) => factor * magnitude >= raw);
  const values = [];
  for (let i = Math.ceil(low / step - 1e-9); i * step <= high + 1e-9 * step; ++i) values.push(i * step);
  return values;
}

// Round values of time: seconds up to hours.
function timeTicks(high, n) {
  const steps = [0.1, 0.2, 0.5, 1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 14400, 36000, 86400];
  const step = steps.find((candidate) => high / candidate <= n) ?? steps.at(-1);
  const values = [];
  for (let i = 0; i * step <= high * (1 + 1e-9); ++i) values.push(i * step);
  const label = step >= 3600 ? (v) => `${v / 3600} h` : step >= 60 ? (v) => `${v / 60} min` : (v) => `${Number(v.toFixed(1))} s`;
  return values.map((value) => ({value, label: label(value)}));
}

const svg = (tag, attributes = {}, text = null) => {
  const element = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  if (text !== null) element.textContent = text;
  return element;
};

// points: [{seconds, steps, samples, psnr, train_psnr}].
function makeCurve(points) {
  const known = points.filter((point) => isNumber(point.seconds) && isNumber(point.psnr));
  const hasTraining = known.some((point) => isNumber(point.train_psnr));
  const plot = svg("svg", {role: "img", "aria-label": "Held-out PSNR over training time"});
  const tip = el("div", {className: "tip", hidden: true});
  const legend = el("div", {className: "legend"}, el("span", {}, el("i"), "held-out views"),
    hasTraining ? el("span", {className: "training"}, el("i"), "training batches") : null);
  const chart = el("div", {className: "chart"}, legend, plot, tip);

  const values = known.flatMap((point) => [point.psnr, point.train_psnr]).filter(isNumber);
  const spread = Math.max(1, Math.max(...values) - Math.min(...values));
  const low = Math.min(...values) - 0.08 * spread, high = Math.max(...values) + 0.08 * spread;
  const lastSecond = Math.max(known.at(-1).seconds, 1e-3);

  onWidth(plot, (width) => {
    const height = Math.max(240, Math.min(380, 0.42 * width)), margin = {left: 48, right: 14, top: 26, bottom: 46};
    const x = (seconds) => margin.left + seconds / lastSecond * (width - margin.left - margin.right);
    const y = (psnr) => height - margin.bottom - (psnr - low) / (high - low) * (height - margin.top - margin.bottom);
    plot.replaceChildren();
    plot.setAttribute("viewBox", `0 0 ${width} ${height}`);
    plot.style.height = `${height}px`;
    for (const value of ticks(low, high, 8)) {
      plot.append(svg("line", {class: "grid", x1: margin.left, x2: width - margin.right, y1: y(value), y2: y(value)}),
        svg("text", {x: margin.left - 10, y: y(value) + 4, "text-anchor": "end"}, Number(value.toFixed(2))));
    }
    for (const {value, label} of timeTicks(lastSecond, width < 500 ? 4 : 8)) {
      plot.append(svg("text", {x: x(value), y: height - margin.bottom + 20, "text-anchor": "middle"}, label));
    }
    plot.append(svg("text", {x: 0, y: 12}, "PSNR (dB)"),
      svg("text", {x: width - margin.right, y: height - 4, "text-anchor": "end"}, "training time"));
    const path = (key) => known.filter((point) => isNumber(point[key]))
      .map((point, i) => `${i === 0 ? "M" : "L"}${x(point.seconds).toFixed(1)},${y(point[key]).toFixed(1)}`).join("");
    if (hasTraining) plot.append(svg("path", {class: "training", d: path("train_psnr")}));
    plot.append(svg("path", {class: "held-out", d: path("psnr")}));
    for (const point of known.length <= 60 ? known : known.slice(-1)) {
      plot.append(svg("circle", {class: "held-out", cx: x(point.seconds), cy: y(point.psnr), r: 4}));
    }

    const cursor = svg("g");
    plot.append(cursor);
    const leave = () => { cursor.replaceChildren(); tip.hidden = true; };
    const hover = (event) => {
      const at = event.clientX - plot.getBoundingClientRect().left;
      const point = known.reduce((best, p) => (Math.abs(x(p.seconds) - at) < Math.abs(x(best.seconds) - at) ? p : best));
      cursor.replaceChildren(
        svg("line", {class: "cursor", x1: x(point.seconds), x2: x(point.seconds), y1: margin.top, y2: height - margin.bottom}),
        svg("circle", {class: "held-out", cx: x(point.seconds), cy: y(point.psnr), r: 6}));
      const line = (label, value) => el("div", {}, el("span", {className: "muted"}, label), el("b", {}, value));
      tip.replaceChildren(line("held-out", `${format.psnr(point.psnr)} dB`), line("time", format.seconds(point.seconds)));
      if (isNumber(point.train_psnr)) {
        cursor.append(svg("circle", {class: "training", cx: x(point.seconds), cy: y(point.train_psnr), r: 5}));
        tip.append(line("training", `${format.psnr(point.train_psnr)} dB`));
      }
      if (isNumber(point.steps)) tip.append(line("steps", format.count(point.steps)));
      if (isNumber(point.samples)) tip.append(line("samples", format.large(point.samples)));
      tip.hidden = false;
      const onLeft = x(point.seconds) > width / 2;
      tip.style.left = `${plot.offsetLeft + x(point.seconds) + (onLeft ? -tip.offsetWidth - 14 : 14)}px`;
      tip.style.top = `${legend.offsetHeight + 40}px`;
    };
    plot.onpointermove = plot.onpointerdown = hover;
    plot.onpointerleave = leave;
  });
  return chart;
}
