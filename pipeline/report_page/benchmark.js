// One row per scene, then the published means.
const {data_set: dataSet, scenes, mean, published, missing} = DATA;
byId("lead").textContent = [
  `${mean.n_scenes} of ${scenes.length} scenes scored`, ...(isNumber(mean.psnr) ? [`mean ${format.psnr(mean.psnr)} dB`] : []),
  `nrff ${DATA.version}`, DATA.host?.cpu, DATA.date].filter(Boolean).join(" · ");

// Paths are relative to this page's folder. Their awkward bytes are %XX already, as in a link.
const link = (path) => path.split("/").map((part) => encodeURIComponent(part).replaceAll("%25", "%")).join("/");
const size = ({width, height}) => (isNumber(width) ? `${width} × ${height}` : DASH);
const lpips = (value) => format.fixed(value, 4);
const failed = ({failure}) => [el("br"), el("span", {className: "pill bad"}, `stopped at ${failure.stage}`), el("br"),
  el("span", {className: "small muted"}, failure.error)];
const name = (scene) => el("span", {}, scene.report ? el("a", {href: link(scene.report)}, scene.name) : scene.name,
  ...(scene.failure ? failed(scene) : []));

byId("scenes").append(makeTable([
  {label: "", value: () => null, cell: (scene) => (scene.picture ? el("img", {className: "thumb", src: scene.picture, alt: ""}) : "")},
  {label: "Scene", value: (scene) => scene.name, cell: name},
  {label: "PSNR (dB)", number: true, value: (scene) => scene.psnr, cell: (scene) => format.psnr(scene.psnr)},
  {label: "SSIM", number: true, value: (scene) => scene.ssim, cell: (scene) => format.ssim(scene.ssim)},
  {label: "LPIPS", number: true, value: (scene) => scene.lpips, cell: (scene) => lpips(scene.lpips)},
  {label: "px", number: true, value: (scene) => scene.width, cell: size},
  {label: "Training", number: true, value: (scene) => scene.training_seconds, cell: (scene) => format.seconds(scene.training_seconds)},
  {label: "Steps", number: true, value: (scene) => scene.steps, cell: (scene) => format.count(scene.steps)},
  {label: "Per view", number: true, value: (scene) => scene.seconds_per_view, cell: (scene) => (isNumber(scene.seconds_per_view) ? `${scene.seconds_per_view.toPrecision(2)} s` : DASH)},
  {label: "Memory", number: true, value: (scene) => scene.peak_memory_bytes, cell: (scene) => format.bytes(scene.peak_memory_bytes)},
], scenes, {stack: true}).element);

byId("beside").hidden = published.length === 0;
if (published.length === 0) byId("how").textContent = "How the figures were made";
const everyScene = missing.length === 0 && scenes.every((scene) => scene.published && isNumber(scene.psnr));
byId("published-hint").textContent = `Published means are over ${dataSet.scenes.join(", ")}. `
  + (everyScene ? "Ours is over the same scenes." : "Ours is over the scenes above: the two cannot be compared as they stand.");
const ours = {method: "nrff, this run", ...mean, training: `${format.seconds(mean.training_seconds)} a scene`, source: DATA.command, own: true};
byId("published").append(makeTable([
  {label: "Method", value: (row) => row.method, cell: (row) => (row.own ? el("strong", {}, row.method) : row.method)},
  {label: "PSNR (dB)", number: true, value: (row) => row.psnr, cell: (row) => format.psnr(row.psnr)},
  {label: "SSIM", number: true, value: (row) => row.ssim, cell: (row) => format.fixed(row.ssim, 3)},
  {label: "LPIPS", number: true, value: (row) => row.lpips, cell: (row) => format.fixed(row.lpips, 3)},
  {label: "Training", value: (row) => row.training || DASH},
  {label: "Source", value: (row) => row.source},
], [ours, ...published], {stack: true}).element);

byId("differences").append(...DATA.differences.map((text) => el("li", {}, text)));

const variant = (key, label) => ({label, number: true, value: (row) => row.variants?.[key], cell: (row) => format.psnr(row.variants?.[key])});
byId("variants").append(makeTable([
  {label: "Scene", value: (row) => row.name},
  {label: "Mean of images", number: true, value: (row) => row.psnr, cell: (row) => format.psnr(row.psnr)},
  variant("psnr_pooled", "Pooled"), variant("psnr_quantised", "Quantised"), variant("psnr_foreground", "Foreground"),
], [...scenes, {name: "mean", ...mean}], {stack: true}).element);
