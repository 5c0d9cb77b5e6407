// One row per capture.
const captures = DATA.captures;
const complete = captures.filter((capture) => capture.status === "complete").length;
byId("lead").textContent = complete === captures.length ? "All of them are complete." : `${complete} of ${captures.length} are complete.`;

// Paths are relative to the folder that this page's folder lies in. Their awkward bytes are %XX already, as in a link.
const link = (capture) => `../${capture.report.split("/").map((part) => encodeURIComponent(part).replaceAll("%25", "%")).join("/")}`;
const status = ({status: state, failure}) => (state === "failed"
  ? el("span", {}, el("span", {className: "pill bad"}, `stopped at ${failure.stage}`), el("br"), el("span", {className: "small muted"}, failure.error))
  : el("span", {className: `pill${state === "complete" ? " yes" : ""}`}, state === "complete" ? "complete" : "not finished"));

const columns = [
  {label: "", value: () => null, cell: (capture) => (capture.picture ? el("img", {className: "thumb", src: capture.picture, alt: ""}) : "")},
  {label: "Capture", value: (capture) => capture.name,
    cell: (capture) => (capture.report ? el("a", {href: link(capture)}, capture.name) : capture.name)},
  {label: "PSNR (dB)", number: true, value: (capture) => capture.metrics.psnr, cell: (capture) => format.psnr(capture.metrics.psnr)},
  {label: "SSIM", number: true, value: (capture) => capture.metrics.ssim, cell: (capture) => format.ssim(capture.metrics.ssim)},
  {label: "Registered", number: true, value: (capture) => capture.split.registered,
    cell: ({split}) => (isNumber(split.registered) ? `${split.registered} of ${split.train + split.test}` : DASH)},
  {label: "Training", number: true, value: (capture) => capture.training_seconds, cell: (capture) => format.seconds(capture.training_seconds)},
  {label: "Total", number: true, value: (capture) => capture.total_seconds, cell: (capture) => format.seconds(capture.total_seconds)},
  {label: "Model", number: true, value: (capture) => capture.model_bytes, cell: (capture) => format.bytes(capture.model_bytes)},
  {label: "State", value: (capture) => capture.status, cell: status},
];
byId("captures").append(makeTable(columns, captures, {stack: true}).element);
