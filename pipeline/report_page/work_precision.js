// Training by budget, rendering by setting, quadrature by samples.
const {training, rendering, quadrature, scoring, poses} = DATA;
byId("lead").textContent = [`nrff ${DATA.version}`, DATA.host?.cpu, DATA.date].filter(Boolean).join(" · ");
for (const part of ["training", "rendering", "quadrature", "scoring", "poses"]) byId(part).hidden = !DATA[part];

// Where the machine's speed decided differently from run to run, how often each.
const presets = (row) => Object.entries(row.presets ?? {}).map(([name, n], i, all) => (all.length > 1 ? `${name} ${n}` : name)).join(", ");

function showTraining() {
  const seeds = training.seeds === 1 ? "one seed" : `${training.seeds} seeds`;
  byId("training-hint").textContent = `Held-out figures after so many seconds of training alone, evaluation not counted; ${seeds}, the band from the least to the most.`;

  const reached = training.bands.filter((band) => band.psnr && band.seconds);
  const trainingPlot = (key, title, y, digits, linear, error) => {
    const points = reached.filter((band) => band[key]).map((band) => ({
      x: band.seconds.mean, y: error(band[key].mean), low: Math.min(error(band[key].least), error(band[key].most)),
      high: Math.max(error(band[key].least), error(band[key].most)),
      label: [[title, band[key].mean.toFixed(digits)], ["training", format.seconds(band.seconds.mean)], ["preset", presets(band)], ["steps", format.count(Math.round(band.steps.mean))]]}));
    return points.length > 0 ? makeLogPlot([{name: title, points}], {title, x: "training time (s)", y, linear}) : null;
  };
  byId("training-plots").append(...[
    trainingPlot("psnr", "PSNR", "dB", 2, true, (value) => value),
    trainingPlot("ssim", "1 − SSIM", "", 4, false, (value) => 1 - value),
    trainingPlot("lpips", "LPIPS", "", 4, false, (value) => value)].filter(Boolean));
  byId("training-table").append(makeTable([
    {label: "Training", number: true, value: (row) => row.budget_seconds, cell: (row) => format.seconds(row.seconds?.mean)},
    {label: "Preset", value: (row) => presets(row)},
    {label: "PSNR (dB)", number: true, value: (row) => row.psnr?.mean, cell: (row) => bandText(row.psnr, format.psnr)},
    {label: "SSIM", number: true, value: (row) => row.ssim?.mean, cell: (row) => bandText(row.ssim, format.ssim)},
    {label: "LPIPS", number: true, value: (row) => row.lpips?.mean, cell: (row) => bandText(row.lpips, format.ssim)},
    {label: "Steps", number: true, value: (row) => row.steps?.mean, cell: (row) => format.count(Math.round(row.steps?.mean))},
    {label: "Density evaluations", number: true, value: (row) => row.samples?.mean, cell: (row) => format.large(Math.round(row.samples?.mean))},
  ], training.bands, {stack: true}).element);
  const marks = training.time_to.filter((mark) => isNumber(mark.seconds)).map((mark) => `${mark.psnr} dB: ${format.seconds(mark.seconds)}`);
  byId("training-table").append(el("p", {className: "hint"}, marks.length > 0 ? `Shortest of these trainings that reaches ${marks.join(", ")}.` : ""));
}

function showRendering() {
  byId("rendering-hint").textContent = `${rendering.n_views} held-out views of ${rendering.width} × ${rendering.height} px, ${rendering.threads} threads. `
    + "One setting is varied, nothing else is left out. The large point is the value that nrff-render uses; the last plot has them together. The step's error is told from an eighth of the training's step, the others' from the same step with every sample shaded. A point without error lies on the lower edge.";
  const setting = (family, point) => (family.family === "colour tolerance" && point.value > 0 ? `${Number((point.value * 255).toPrecision(2))}/255` : shortNumber(point.value));
  const floor = 1e-7;
  byId("rendering-plots").append(...rendering.families.map((family) => makeLogPlot([{name: family.family,
    points: family.points.map((point) => ({x: point.seconds, y: Math.max(point.rmse, floor), chosen: point.chosen,
      label: [[family.family, setting(family, point)], ["rms error", shortNumber(point.rmse)], ["a view", `${point.seconds.toPrecision(2)} s`],
        ["to the photos", `${format.psnr(point.psnr)} dB`]]}))}],
  {title: `${family.family[0].toUpperCase()}${family.family.slice(1)}: ${family.meaning}`, x: "seconds a view", y: "rms error of RGB"})));
  const rows = rendering.families.flatMap((family) => family.points.map((point) => ({family, point})));
  byId("rendering-table").append(makeTable([
    {label: "Setting", value: ({family}) => family.family, cell: ({family, point}) => (point.chosen ? el("strong", {}, family.family) : family.family)},
    {label: "Value", number: true, value: ({point}) => point.value, cell: ({family, point}) => (point.chosen ? el("strong", {}, setting(family, point)) : setting(family, point))},
    {label: "Seconds a view", number: true, value: ({point}) => point.seconds, cell: ({point}) => point.seconds.toPrecision(3)},
    {label: "rms error", number: true, value: ({point}) => point.rmse, cell: ({point}) => shortNumber(point.rmse)},
    {label: "Largest", number: true, value: ({point}) => point.most, cell: ({point}) => shortNumber(point.most)},
    {label: "Samples a ray", number: true, value: ({point}) => point.samples_per_ray, cell: ({point}) => format.fixed(point.samples_per_ray, 1)},
    {label: "Shaded", number: true, value: ({point}) => point.shaded_per_ray, cell: ({point}) => format.fixed(point.shaded_per_ray, 2)},
    {label: "PSNR (dB)", number: true, value: ({point}) => point.psnr, cell: ({point}) => format.psnr(point.psnr)},
  ], rows, {long: true}).element);
}

function showQuadrature() {
  byId("quadrature-plots").append(makeLogPlot(quadrature.map((density) => ({name: density.density,
    points: density.points.map((point) => ({x: point.n_samples, y: Math.max(point.error, 1e-10),
      label: [[density.density, `${point.n_samples} samples`], ["error", shortNumber(point.error)], ["a ray", `${(point.seconds * 1e6).toPrecision(2)} µs`]]}))})),
  {title: "Transmittance behind the ray", x: "samples a ray", y: "|T − closed form|"}));
}

function showScoring() {
  const series = ["psnr", "ssim", "lpips"].map((key) => ({name: key.toUpperCase(), points: scoring.filter((point) => isNumber(point.seconds[key])).map((point) => ({
    x: point.width * point.height, y: Math.max(point.seconds[key], 1e-7), chosen: point.chosen,
    label: [[key.toUpperCase(), format.fixed(point[key], 4)], ["image", `${point.width} × ${point.height}`], ["seconds", point.seconds[key].toPrecision(2)]]}))}));
  byId("scoring-plots").append(makeLogPlot(series.filter((one) => one.points.length > 0), {title: "Time by image size", x: "pixels", y: "seconds an image"}));
  const seconds = (key) => ({label: `${key.toUpperCase()} (s)`, number: true, value: (point) => point.seconds[key], cell: (point) => (isNumber(point.seconds[key]) ? point.seconds[key].toPrecision(2) : DASH)});
  byId("scoring-table").append(makeTable([
    {label: "Image", number: true, value: (point) => point.width, cell: (point) => `${point.width} × ${point.height}`},
    {label: "PSNR (dB)", number: true, value: (point) => point.psnr, cell: (point) => format.psnr(point.psnr)},
    {label: "SSIM", number: true, value: (point) => point.ssim, cell: (point) => format.ssim(point.ssim)},
    {label: "LPIPS", number: true, value: (point) => point.lpips, cell: (point) => format.ssim(point.lpips)},
    seconds("psnr"), seconds("ssim"), seconds("lpips"),
  ], scoring, {stack: true}).element);
}

function showPoses() {
  byId("poses-hint").textContent = poses.reason ? `Not measured: ${poses.reason}.`
    : "Estimated from the photos alone and compared with the capture's own after a robust alignment; positions in % of the cameras' rms distance from their mean. AUC: area under the recall curve of relative poses up to 5°, photos without a pose counted as misses. The large point is what nrff run begins with for so many photos.";
  if (poses.points.length === 0) return;
  const text = (point) => `${point.image_size} px, ${point.features} features, ${point.matching}`;
  const good = poses.points.filter((point) => point.errors && isNumber(point.seconds));
  const plot = (title, y, error) => makeLogPlot([{name: title, points: [...good].sort((a, b) => a.seconds - b.seconds).map((point) => ({
    x: point.seconds, y: Math.max(error(point), 1e-6), chosen: point.chosen,
    label: [["setting", text(point)], [title, shortNumber(error(point))], ["COLMAP", format.seconds(point.seconds)], ["registered", `${point.n_registered} of ${point.n_images}`]]}))}],
  {title, x: "seconds of COLMAP", y, scatter: true});
  if (good.length > 1) {
    byId("poses-plots").append(plot("Median position error", "%", (point) => 100 * point.errors.position.median),
      plot("Median rotation error", "°", (point) => point.errors.rotation_deg.median));
}
byId("poses-table").append(makeTable([
  {label: "Photos", number: true, value: (point) => point.image_size, cell: (point) => `${point.image_size} px`},
  {label: "Features", number: true, value: (point) => point.features},
  {label: "Matching", value: (point) => point.matching, cell: (point) => (point.chosen ? el("strong", {}, point.matching) : point.matching)},
  {label: "COLMAP", number: true, value: (point) => point.seconds, cell: (point) => format.seconds(point.seconds)},
  {label: "Registered", number: true, value: (point) => point.n_registered, cell: (point) => (point.error ?? `${point.n_registered} of ${point.n_images}`)},
  {label: "Position", number: true, value: (point) => point.errors?.position.median, cell: (point) => (point.errors ? `${(100 * point.errors.position.median).toFixed(3)} %` : DASH)},
  {label: "Rotation", number: true, value: (point) => point.errors?.rotation_deg.median, cell: (point) => (point.errors ? `${point.errors.rotation_deg.median.toFixed(3)}°` : DASH)},
  {label: "AUC to 5°", number: true, value: (point) => point.errors?.relative_deg.auc["5"], cell: (point) => format.fixed(point.errors?.relative_deg.auc["5"], 3)},
], poses.points, {stack: true}).element);
}

if (training) showTraining();
if (rendering) showRendering();
if (quadrature) showQuadrature();
if (scoring) showScoring();
if (poses) showPoses();
