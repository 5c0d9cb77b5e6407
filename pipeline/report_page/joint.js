// One row per capture.
const captures = DATA.captures;
const complete = captures.filter((capture) => capture.status === "complete").length;
byId("lead").textContent = complete === captures.length ? "All of them are complete." : `${complete} of ${captures.length} are complete.`;

// Paths are relative to the folder that this page's folder lies in. Their awkward bytes are %XX already, as in a link.
const link = (capture) => `../${capture.report.split("/").map((part) => encodeURIComponent(part).replaceAll("%25", "%")).join("/")}`;
const status = ({status: state, failure}) => (state === "failed"
  ? el("span", {}, el("span", {className: "pill bad"}, `stopped at ${failure.stage}`), el("br"), el("span", {className: "small muted"}, failure.error))
  : el("span", {className: `pill${state === "complete" ? " yes" : ""}`}, state === "complete" ? "complete" : "not finished"));

// Runs of one capture have its name in common: their workspaces tell them apart.
const isShared = (capture) => captures.filter((other) => other.name === capture.name).length > 1;
const nameOf = (capture) => (isShared(capture) ? capture.workspace.split("/").at(-1) : capture.name);

const columns = [
  {label: "", value: () => null, cell: (capture) => (capture.picture ? el("img", {className: "thumb", src: capture.picture, alt: ""}) : "")},
  {label: "Run", value: nameOf,
    cell: (capture) => el("span", {}, capture.report ? el("a", {href: link(capture)}, nameOf(capture)) : nameOf(capture),
      isShared(capture) ? el("span", {className: "small muted"}, ` ${capture.name}`) : null)},
  {label: "PSNR (dB)", number: true, value: (capture) => capture.metrics.psnr, cell: (capture) => format.psnr(capture.metrics.psnr)},
  {label: "SSIM", number: true, value: (capture) => capture.metrics.ssim, cell: (capture) => format.ssim(capture.metrics.ssim)},
  ...(captures.some((capture) => isNumber(capture.metrics.lpips))
    ? [{label: "LPIPS", number: true, value: (capture) => capture.metrics.lpips, cell: (capture) => format.fixed(capture.metrics.lpips, 4)}] : []),
  {label: "Registered", number: true, value: (capture) => capture.split.registered,
    cell: ({split}) => (isNumber(split.registered) ? `${split.registered} of ${split.train + split.test}` : DASH)},
  {label: "Training", number: true, value: (capture) => capture.training_seconds, cell: (capture) => format.seconds(capture.training_seconds)},
  {label: "Total", number: true, value: (capture) => capture.total_seconds, cell: (capture) => format.seconds(capture.total_seconds)},
  {label: "Model", number: true, value: (capture) => capture.model_bytes, cell: (capture) => format.bytes(capture.model_bytes)},
  {label: "State", value: (capture) => capture.status, cell: status},
];
byId("captures").append(makeTable(columns, captures, {stack: true}).element);

const series = captures.map((capture) => ({name: nameOf(capture), points: (capture.curve ?? []).filter((point) => isNumber(point.psnr) && point.seconds > 0)
  .map((point) => ({x: point.seconds, y: point.psnr,
    label: [["run", nameOf(capture)], ["held-out", `${format.psnr(point.psnr)} dB`], ["training", format.seconds(point.seconds)], ["steps", format.count(point.steps)]]}))}))
  .filter((one) => one.points.length > 0);
byId("curves").hidden = series.length === 0;
if (series.length > 0) byId("curve-plot").append(makeLogPlot(series, {title: "Held-out PSNR", x: "training time (s)", y: "dB", linear: true}));

// A row per view: the photo, then what every run shows, or where it is wrong.
function showComparison({capture, runs, views}) {
  const pictures = [];
  const show = (layer) => {
    for (const {image, shown} of pictures) image.src = shown[layer] ?? "";
    for (const button of buttons) button.setAttribute("aria-pressed", String(button.dataset.layer === layer));
  };
  const buttons = [["rendered", "Renders"], ["error", "Errors"]].map(([layer, label]) => {
    const button = el("button", {type: "button", className: "pill", onclick: () => show(layer)}, label);
    button.dataset.layer = layer;
    return button;
  });
  const figure = (image, caption) => el("figure", {}, image, el("figcaption", {}, ...caption));
  const rows = views.map((view) => {
    const best = Math.max(...view.shown.map((shown) => shown.psnr ?? -Infinity));
    return el("div", {className: "side-by-side"}, figure(el("img", {src: view.truth ?? "", alt: `${view.name}, the photo`}), [view.name]),
      ...view.shown.map((shown, i) => {
        const run = nameOf(captures[runs[i]]), image = el("img", {alt: `${view.name}, ${run}`}), psnr = `${format.psnr(shown.psnr)} dB`;
        pictures.push({image, shown});
        return figure(image, [`${run} · `, shown.psnr === best ? el("strong", {}, psnr) : psnr]);
      }));
  });
  byId("comparisons").append(el("section", {}, el("h2", {}, `${capture}, side by side`),
    el("p", {className: "hint"}, "The worst, the median and the best of the held-out views by mean PSNR of these runs. ", ...buttons), ...rows));
  show("rendered");
}
for (const comparison of DATA.comparisons ?? []) showComparison(comparison);
